#include "xbus.h"

#include <string.h>

static const uint8_t PREAMBLE = 0xFA;
// Of a sensor that is connected directly.
static const uint8_t BUS_ID = 0xFF;
static const uint8_t EXTENDED_LENGTH = 0xFF;

uint8_t write_packet(uint8_t message, const uint8_t *data, uint8_t size, uint8_t *out) {
    out[0] = PREAMBLE;
    out[1] = BUS_ID;
    out[2] = message;
    out[3] = size;
    uint8_t sum = BUS_ID + message + size;
    for (uint8_t i = 0; i < size; ++i) {
        out[4 + i] = data[i];
        sum += data[i];
    }
    out[4 + size] = -sum;
    return size + 5;
}

void Framer::drop(uint16_t count) {
    length_ -= count;
    memmove(bytes_, bytes_ + count, length_);
}

// Gives up all before the first preamble at `from` or behind it.
void Framer::skip_to_preamble(uint16_t from) {
    while (from < length_ && bytes_[from] != PREAMBLE) {
        ++from;
    }
    skipped_bytes += from;
    drop(from);
}

void Framer::give_up() {
    wrong_sums += wrong_sums != UINT16_MAX;
    skip_to_preamble(1);
}

void Framer::reject() {
    taken_ = 0;
    give_up();
}

bool Framer::next(Packet &packet) {
    drop(taken_);
    taken_ = 0;
    skip_to_preamble(0);
    if (length_ >= 2 && bytes_[1] != BUS_ID) {
        skip_to_preamble(1);
        return false;
    }
    if (length_ < 6 && (length_ < 4 || bytes_[3] == EXTENDED_LENGTH)) {
        return false;
    }
    bool is_extended = bytes_[3] == EXTENDED_LENGTH;
    uint8_t header_bytes = is_extended ? 6 : 4;
    uint16_t size = is_extended ? read_u16(bytes_ + 4) : bytes_[3];
    if (size > MAX_PACKET_DATA_BYTES) {
        give_up();
        return false;
    }
    uint16_t whole_bytes = header_bytes + size + 1;
    if (length_ < whole_bytes) {
        return false;
    }
    uint8_t sum = 0;
    for (uint16_t i = 1; i < whole_bytes; ++i) {
        sum += bytes_[i];
    }
    if (sum != 0) {
        give_up();
        return false;
    }
    packet.message = bytes_[2];
    packet.data = bytes_ + header_bytes;
    packet.size = size;
    taken_ = whole_bytes;
    return true;
}

// Kinds of items: the identifier without precision and axes.
enum Item {
    UTC = 0x1010,
    PACKET_COUNTER = 0x1020,
    SAMPLE_TIME_FINE = 0x1060,
    EULER_ANGLES = 0x2030,
    HEIGHT = 0x5020,
    LATITUDE_LONGITUDE = 0x5040,
    GNSS_PVT = 0x7010,
    GPS_DOP = 0x8830,
    GPS_SOL = 0x8840,
    STATUS_WORD = 0xE020,
};

static bool read_numbers(const uint8_t *content, uint8_t size, uint16_t identifier, uint8_t count, Q32 *values,
                         bool &is_refused) {
    Precision precision = (Precision)(identifier & 3);
    uint8_t bytes = number_bytes(precision);
    if (size != count * bytes) {
        return false;
    }
    for (uint8_t i = 0; i < count; ++i) {
        if (!read_number(content + i * bytes, precision, values[i])) {
            is_refused = true;
        }
    }
    return true;
}

// The flags' bit 2: this is UTC. Until the receiver knows the leap seconds it is not, and then it is no time at all.
static void read_utc(const uint8_t *content, Said &said) {
    UtcSaid &utc = said.utc;
    utc.nanosecond = read_u32(content);
    utc.year = read_u16(content + 4);
    utc.month = content[6];
    utc.day = content[7];
    utc.hour = content[8];
    utc.minute = content[9];
    utc.second = content[10];
    bool is_utc = content[11] & 4;
    said.has_utc = is_utc && utc.nanosecond < 1000000000 && utc.year >= 2000 && utc.year < 2200 && utc.month >= 1 &&
                   utc.month <= 12 && utc.day >= 1 && utc.day <= 31 && utc.hour < 24 && utc.minute < 60 &&
                   (utc.second < 60 || (utc.second == 60 && utc.hour == 23 && utc.minute == 59));
}

// Roll, pitch, yaw about the axes of an east-north-up, north-east-down or north-west-up frame.
static void read_attitude(const Q32 *angles_deg, uint8_t axes, Said &said) {
    Q32 yaw_deg = angles_deg[2];
    bool is_angle = magnitude(angles_deg[0]) <= 180 * Q32_ONE && magnitude(angles_deg[1]) <= 90 * Q32_ONE &&
                    magnitude(yaw_deg) <= 360 * Q32_ONE;
    if (!is_angle || axes > 2) {
        said.is_refused = true;
        return;
    }
    enum { EAST_NORTH_UP, NORTH_EAST_DOWN };
    Q32 heading_deg = axes == NORTH_EAST_DOWN ? yaw_deg : -yaw_deg;
    if (axes == EAST_NORTH_UP) {
        heading_deg += 90 * Q32_ONE;
    }
    // Twice 360000, so that the remainder is that of a positive number.
    said.heading_mdeg = (uint32_t)(rounded(heading_deg, 1000) + 720000) % 360000;
    // Right-handed about the axis to port the bow goes down, about that to starboard up.
    said.roll_cdeg = rounded(angles_deg[0], 100);
    said.pitch_cdeg = rounded(axes == NORTH_EAST_DOWN ? angles_deg[1] : -angles_deg[1], 100);
    said.has_attitude = true;
}

static void read_place(const Q32 *place_deg, uint8_t precision, Said &said) {
    bool is_on_earth = magnitude(place_deg[0]) <= 90 * Q32_ONE && magnitude(place_deg[1]) <= 180 * Q32_ONE;
    // A 32-bit float steps by half a metre and more.
    if (!is_on_earth || precision == F32) {
        said.is_refused = true;
        return;
    }
    said.latitude_deg = place_deg[0];
    said.longitude_deg = place_deg[1];
    said.has_place = true;
}

// u-blox NAV-PVT, big-endian: `!IHBBBBBBIiBBBBiiiiIIiiiiiIIiHHHHHHH` in the words of Python's `struct`.
static void read_pvt(const uint8_t *content, ReceiverSaid &receiver) {
    const uint8_t FIX_IS_GOOD = 1, FIX_IS_DIFFERENTIAL = 2;
    bool is_good = content[21] & FIX_IS_GOOD;
    receiver.is_differential = is_good && (content[21] & FIX_IS_DIFFERENTIAL);
    receiver.satellites = content[22];
    receiver.has_satellites = true;
    uint32_t horizontal_mm = read_u32(content + 40), vertical_mm = read_u32(content + 44);
    receiver.has_std = is_good && horizontal_mm != 0 && vertical_mm != 0;
    // The accuracy is that of the distance; half of its square falls to each axis. 46341 / 65536 = 1 / sqrt(2).
    receiver.std_mm[0] = receiver.std_mm[1] = ((uint64_t)horizontal_mm * 46341 + 32768) >> 16;
    receiver.std_mm[2] = vertical_mm;
    receiver.horizontal_dilution_centi = read_u16(content + 88);
    receiver.has_horizontal_dilution = receiver.horizontal_dilution_centi != 0;
}

// u-blox NAV-SOL and NAV-DOP, big-endian.
static void read_sol(const uint8_t *content, ReceiverSaid &receiver) {
    const uint8_t FIX_IS_GOOD = 1, FIX_IS_DIFFERENTIAL = 2;
    bool is_good = content[11] & FIX_IS_GOOD;
    receiver.is_differential = is_good && (content[11] & FIX_IS_DIFFERENTIAL);
    uint32_t accuracy_cm = read_u32(content + 24);
    receiver.has_accuracy = is_good && accuracy_cm != 0 && accuracy_cm < 10000000;
    receiver.accuracy_mm = accuracy_cm * 10;
    receiver.satellites = content[47];
    receiver.has_satellites = true;
}

static void read_dop(const uint8_t *content, ReceiverSaid &receiver) {
    // Time of week; dilutions of all, position, time, vertical, horizontal, north, east.
    receiver.dilution_centi[0] = read_u16(content + 14);
    receiver.dilution_centi[1] = read_u16(content + 16);
    receiver.dilution_centi[2] = read_u16(content + 10);
    receiver.dilution_centi[3] = read_u16(content + 6);
    receiver.has_dilutions = receiver.dilution_centi[3] != 0;
    receiver.horizontal_dilution_centi = read_u16(content + 12);
    receiver.has_horizontal_dilution = receiver.horizontal_dilution_centi != 0;
}

static bool read_item(uint16_t identifier, const uint8_t *content, uint8_t size, Said &said) {
    Q32 values[3];
    bool is_refused = false;
    switch (identifier & 0xFFF0) {
    case UTC:
        if (size != 12) {
            return false;
        }
        read_utc(content, said);
        break;
    case PACKET_COUNTER:
        if (size != 2) {
            return false;
        }
        said.counter = read_u16(content);
        said.has_counter = true;
        break;
    case SAMPLE_TIME_FINE:
        if (size != 4) {
            return false;
        }
        said.ticks = read_u32(content);
        said.has_ticks = true;
        break;
    case EULER_ANGLES:
        if (!read_numbers(content, size, identifier, 3, values, is_refused)) {
            return false;
        }
        if (!is_refused) {
            read_attitude(values, identifier >> 2 & 3, said);
        }
        break;
    case HEIGHT:
        if (!read_numbers(content, size, identifier, 1, values, is_refused)) {
            return false;
        }
        said.has_height = !is_refused;
        said.height_cm = is_refused ? 0 : rounded(values[0], 100);
        break;
    case LATITUDE_LONGITUDE:
        if (!read_numbers(content, size, identifier, 2, values, is_refused)) {
            return false;
        }
        if (!is_refused) {
            read_place(values, identifier & 3, said);
        }
        break;
    case GNSS_PVT:
        if (size != 94) {
            return false;
        }
        said.has_receiver = true;
        read_pvt(content, said.receiver);
        break;
    case GPS_DOP:
        if (size != 18) {
            return false;
        }
        said.has_receiver = true;
        read_dop(content, said.receiver);
        break;
    case GPS_SOL:
        if (size != 52) {
            return false;
        }
        said.has_receiver = true;
        read_sol(content, said.receiver);
        break;
    case STATUS_WORD:
        if (size != 4) {
            return false;
        }
        said.status = read_u32(content);
        said.has_status = true;
        break;
    }
    said.is_refused |= is_refused;
    return true;
}

bool parse_measurement(const uint8_t *data, uint16_t size, Said &said) {
    memset(&said, 0, sizeof(said));
    while (size > 0) {
        if (size < 3 || size - 3 < data[2] || !read_item(read_u16(data), data + 3, data[2], said)) {
            return false;
        }
        size -= 3 + data[2];
        data += 3 + data[2];
    }
    return true;
}
