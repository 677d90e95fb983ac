// The sensor's bytes -> lines for the computer: which line is sent when.
#pragma once

#include "device.h"
#include "lines.h"

// Lets things through at a rate, by the stamps of what comes. What comes at that rate or more slowly passes unthinned.
class Pace {
  public:
    // In ticks of the sensor's clock, 10 kHz.
    explicit Pace(uint16_t period_ticks) : period_ticks_(period_ticks) {}

    bool is_due(uint32_t ticks);

  private:
    uint16_t period_ticks_;
    uint32_t next_ticks_ = 0;
    bool has_started_ = false;
};

class Bridge {
  public:
    Bridge();

    bool has_room() const { return framer_.has_room(); }

    // A byte of the sensor; only while there is room.
    void push(uint8_t byte) { framer_.push(byte); }

    // Does what is due, at most one packet of the sensor.
    void poll(uint32_t now_ms);

    // What the lamp shows: is the sensor there, does it know where it is.
    bool is_measuring(uint32_t now_ms) const;
    bool has_fix(uint32_t now_ms) const;

  private:
    void measurement(const Said &said, uint32_t now_ms);
    void remember(const Said &said, uint32_t now_ms);
    void remember_receiver(const ReceiverSaid &said);
    void date(const Said &said, const SampleTime &time);
    void position(const Said &said, const SampleTime &time, uint32_t ticks, uint32_t now_ms);
    void attitude(const Said &said, const SampleTime &time, uint32_t now_ms);
    void heartbeat(uint32_t now_ms);
    Quality quality(uint32_t now_ms) const;
    bool send(Line &line, uint16_t keep_free);

    Framer framer_;
    Device device_;
    Pace attitude_pace_;
    Pace position_pace_;

    // What was said last, and when.
    uint32_t status_ = 0;
    ReceiverSaid receiver_ = ReceiverSaid();
    int32_t height_cm_ = 0;
    bool has_status_ = false, has_receiver_ = false, has_height_ = false, has_place_ = false, has_counter_ = false;
    uint32_t status_ms_ = 0, receiver_ms_ = 0, height_ms_ = 0, place_ms_ = 0;
    uint16_t counter_ = 0;
    // Of the last date; no second before the first.
    uint8_t date_second_ = 61;

    bool has_beaten_ = false;
    uint32_t beat_ms_ = 0;
    uint32_t uptime_s_ = 0;

    // What the heartbeat says.
    uint32_t packets_ = 0, positions_ = 0, headings_ = 0, no_fixes_ = 0, dropped_lines_ = 0, missed_packets_ = 0;
    uint16_t refused_ = 0;
};
