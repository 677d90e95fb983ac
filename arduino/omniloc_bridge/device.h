// The conversation with the sensor: tells it what to send, and notices when it is gone or back.
//
//   GoToConfig -> what do you send? -> (send this) -> GoToMeasurement -> measurements
//
// Every request is repeated until it is answered. The outputs are only set if they are others than ours, as the sensor
// keeps them in its flash memory. A sensor that measures and does not answer, as its receive line is not wired, is
// listened to and asked again every ten seconds. What comes after a second of silence is asked from the start.
#pragma once

#include "xbus.h"

class Device {
  public:
    // Sends what is due.
    void poll(uint32_t now_ms);
    // A message other than a measurement.
    void message(const Packet &packet, uint32_t now_ms);
    // A measurement has come.
    void measured(uint32_t now_ms);

    // `M` measures as asked for, `L` measures, but as it was set up by others, `C` is being configured, `S` silent.
    char state(uint32_t now_ms) const;

    // How often it fell silent or started anew while it was measuring.
    uint16_t losses = 0;

  private:
    enum Step { ASK_FOR_CONFIG, ASK_OUTPUTS, SET_OUTPUTS, START, MEASURING, LISTENING };

    static uint8_t request_of(Step step);
    void go_to(Step step);
    void restart(uint32_t now_ms);
    void send_request(uint32_t now_ms);
    void no_answer(uint32_t now_ms);
    void outputs_set(const Packet &packet);
    bool is_heard(uint32_t now_ms) const;

    Step step_ = ASK_FOR_CONFIG;
    // Which of the sets of outputs is asked for, and whether the sensor has agreed to one.
    uint8_t outputs_ = 0;
    bool is_agreed_ = false;
    // Requests of this step so far.
    uint8_t tries_ = 0;
    uint32_t asked_ms_ = 0;
    bool has_answered_ = false;
    bool has_measured_ = false;
    uint32_t measured_ms_ = 0;
};
