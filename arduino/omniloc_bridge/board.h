// What the bridge needs of the board: two serial lines that never make anyone wait, and a pulse.
#pragma once

#include <stdint.h>

// Counts of the hardware.
struct BoardCounters {
    // Bytes of the sensor that were lost because nobody fetched them in time, in the hardware or in the buffer.
    uint16_t overruns;
    // Bytes of the sensor whose stop bit was missing: noise, or another baud rate.
    uint16_t framing_errors;
    // Most bytes of the sensor that have waited, of 255.
    uint8_t peak_waiting;
    // Pulses of the receiver, and the microseconds between the last two.
    uint16_t pulses;
    uint32_t pulse_interval_us;
};

// Queues a whole line for the computer, if that leaves so many bytes of the queue free; false if it was dropped.
bool board_send_line(const char *line, uint8_t length, uint16_t keep_free);

// Queues a message to the sensor. One that does not fit is dropped, and asked again as any that is not answered.
void board_send_to_device(const uint8_t *message, uint8_t length);

BoardCounters board_counters();
