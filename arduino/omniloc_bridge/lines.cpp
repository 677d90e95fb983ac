#include "lines.h"

void Line::text(const char *text) {
    while (*text) {
        character(*text++);
    }
}

void Line::character(char character) {
    if (length_ < sizeof(bytes_)) {
        bytes_[length_++] = character;
    }
}

// By subtraction: the AVR divides 32 bits in 600 cycles, and there are thousands of digits a second.
void Line::digits(uint32_t value, uint8_t width) {
    static const uint32_t POWERS[] = {1000000000, 100000000, 10000000, 1000000, 100000, 10000, 1000, 100, 10, 1};
    const uint8_t COUNT = sizeof(POWERS) / sizeof(POWERS[0]);
    bool has_started = false;
    for (uint8_t i = 0; i < COUNT; ++i) {
        char digit = '0';
        while (value >= POWERS[i]) {
            value -= POWERS[i];
            ++digit;
        }
        has_started = has_started || digit != '0' || COUNT - i <= width;
        if (has_started) {
            character(digit);
        }
    }
}

void Line::decimal(int32_t value, uint8_t decimals) {
    if (value < 0) {
        character('-');
    }
    uint32_t size = value < 0 ? -(uint32_t)value : value;
    digits(size, decimals + 1);
    // Make room for the point in front of the decimals.
    character('.');
    for (uint8_t i = 0; i < decimals; ++i) {
        bytes_[length_ - 1 - i] = bytes_[length_ - 2 - i];
    }
    bytes_[length_ - 1 - decimals] = '.';
}

void Line::field(uint32_t value) {
    character(',');
    digits(value);
}

static char hexadecimal(uint8_t value) { return value < 10 ? '0' + value : 'A' + value - 10; }

void Line::finish() {
    uint8_t sum = 0;
    for (uint8_t i = 1; i < length_; ++i) {
        sum ^= bytes_[i];
    }
    character('*');
    character(hexadecimal(sum >> 4));
    character(hexadecimal(sum & 15));
    character('\r');
    character('\n');
}

SampleTime sample_time(const Said &said) {
    const UtcSaid &utc = said.utc;
    uint16_t millisecond = (utc.nanosecond + 500000) / 1000000;
    SampleTime time = {said.has_utc, false, utc.hour, utc.minute, utc.second, millisecond};
    if (millisecond < 1000) {
        return time;
    }
    if (time.second == 60) { // A leap second: what comes next depends on no clock arithmetic.
        time.millisecond = 999;
        return time;
    }
    time.millisecond = 0;
    if (++time.second == 60) {
        time.second = 0;
        if (++time.minute == 60) {
            time.minute = 0;
            if (++time.hour == 24) {
                time.hour = 0;
                time.is_next_day = true;
            }
        }
    }
    return time;
}

// `,hhmmss.sss`
static void write_time(Line &line, const SampleTime &time) {
    line.character(',');
    if (!time.is_known) {
        return;
    }
    line.digits(time.hour, 2);
    line.digits(time.minute, 2);
    line.digits(time.second, 2);
    line.character('.');
    line.digits(time.millisecond, 3);
}

void write_date(Line &line, const SampleTime &time, const UtcSaid &utc) {
    write_time(line, time);
    line.character(',');
    line.digits(utc.day, 2);
    line.character(',');
    line.digits(utc.month, 2);
    line.character(',');
    line.digits(utc.year, 4);
    line.text(",00,00");
}

void write_deviation(Line &line, const SampleTime &time, const uint32_t *std_mm) {
    write_time(line, time);
    line.text(",,,,");
    for (uint8_t i = 0; i < 3; ++i) {
        line.character(',');
        line.decimal(std_mm[i], 3);
    }
}

// `,ddmm.mmmmmm,N`
static void write_coordinate(Line &line, Q32 value_deg, uint8_t degree_digits, const char *hemispheres) {
    uint8_t degrees;
    uint32_t micro_minutes;
    degrees_and_micro_minutes(value_deg, degrees, micro_minutes);
    line.character(',');
    line.digits(degrees, degree_digits);
    line.digits(micro_minutes / 1000000, 2);
    line.character('.');
    line.digits(micro_minutes % 1000000, 6);
    line.character(',');
    line.character(hemispheres[value_deg < 0]);
}

void write_position(Line &line, const SampleTime &time, const Said &said, Quality quality, const ReceiverSaid &receiver,
                    const int32_t *height_cm) {
    const uint16_t MAX_DILUTION_CENTI = 9990;
    write_time(line, time);
    write_coordinate(line, said.latitude_deg, 2, "NS");
    write_coordinate(line, said.longitude_deg, 3, "EW");
    line.field(quality);
    line.character(',');
    if (receiver.has_satellites) {
        line.digits(receiver.satellites, 2);
    }
    line.character(',');
    if (receiver.has_horizontal_dilution) {
        uint16_t centi = receiver.horizontal_dilution_centi;
        line.decimal(((centi < MAX_DILUTION_CENTI ? centi : MAX_DILUTION_CENTI) + 5) / 10, 1);
    }
    line.character(',');
    if (height_cm) {
        line.decimal(*height_cm, 2);
    }
    // The sensor's height is above the ellipsoid: no separation is left.
    line.text(",M,0.0,M,,");
}

void write_no_position(Line &line, const SampleTime &time) {
    write_time(line, time);
    line.text(",,,,,0,00,99.9,,M,,M,,");
}

void write_attitude(Line &line, const SampleTime &time, const Said &said, Heading heading, bool has_position) {
    write_time(line, time);
    line.character(',');
    if (heading == TRUE_NORTH) {
        line.decimal(said.heading_mdeg, 3);
    }
    line.text(",T,");
    if (heading != UNKNOWN) {
        line.decimal(said.roll_cdeg, 2);
        line.character(',');
        line.decimal(said.pitch_cdeg, 2);
    } else {
        line.character(',');
    }
    // Heave and the three deviations, of which the sensor says nothing.
    line.text(",,,,,");
    line.digits(has_position);
}

void write_magnetic_heading(Line &line, const Said &said) {
    line.character(',');
    line.decimal(said.heading_mdeg, 3);
    line.text(",M");
}
