// The lines that go to the computer: NMEA 0183 sentences, as docs/arduino-lines.md describes them.
#pragma once

#include "xbus.h"

// One sentence under way, without dynamic memory or printf.
class Line {
  public:
    // `start`: `$` and what identifies the sentence.
    explicit Line(const char *start) { text(start); }

    void text(const char *text);
    void character(char character);
    // With zeros in front up to `width`, at most 10 digits.
    void digits(uint32_t value, uint8_t width = 1);
    // `value` counts in units of 10^-decimals.
    void decimal(int32_t value, uint8_t decimals);
    // `,` and the number.
    void field(uint32_t value);
    // Appends `*`, the XOR of all after `$` as two hexadecimal digits, and the line end.
    void finish();

    const char *bytes() const { return bytes_; }
    uint8_t length() const { return length_; }

  private:
    // The longest, a heartbeat with all counters at their end, has 87.
    char bytes_[96];
    uint8_t length_ = 0;
};

// When something was measured, to the millisecond.
struct SampleTime {
    bool is_known;
    // Rounding has gone past midnight, so that the date of the packet is no longer that of the time.
    bool is_next_day;
    uint8_t hour, minute, second;
    uint16_t millisecond;
};

SampleTime sample_time(const Said &said);

// As GGA has it.
enum Quality { NO_FIX = 0, AUTONOMOUS = 1, DIFFERENTIAL = 2, DEAD_RECKONING = 6 };

enum Heading { UNKNOWN, TRUE_NORTH, MAGNETIC_NORTH };

// $GNZDA
void write_date(Line &line, const SampleTime &time, const UtcSaid &utc);
// $GNGST
void write_deviation(Line &line, const SampleTime &time, const uint32_t *std_mm);
// $GNGGA; `height_cm` may be null.
void write_position(Line &line, const SampleTime &time, const Said &said, Quality quality, const ReceiverSaid &receiver,
                    const int32_t *height_cm);
// $GNGGA without a position.
void write_no_position(Line &line, const SampleTime &time);
// $PASHR
void write_attitude(Line &line, const SampleTime &time, const Said &said, Heading heading, bool has_position);
// $HCHDM
void write_magnetic_heading(Line &line, const Said &said);
