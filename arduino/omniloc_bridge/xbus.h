// Bytes of the sensor -> Xbus packets -> what one MTData2 packet says.
//
//   FA FF id length data sum                      sum makes the bytes after FA add up to 0 (mod 256)
//   FA FF id FF length-high length-low data sum   the same with more than 254 bytes of data
//
// The data of MTData2 are items: identifier (16 bits), size in bytes (8 bits), content, all big-endian (Xsens, "MT Low
// Level Communication Protocol").
#pragma once

#include "fixed.h"

// Identifiers of messages. A reply has that of its request plus 1.
enum Message {
    GO_TO_MEASUREMENT = 0x10,
    GO_TO_CONFIG = 0x30,
    MTDATA2 = 0x36,
    WAKE_UP = 0x3E,
    ERROR = 0x42,
    OUTPUT_CONFIGURATION = 0xC0,
};

// What we ask for takes 146 bytes; sensors that were set up by somebody else may send more.
const uint16_t MAX_PACKET_DATA_BYTES = 512;

struct Packet {
    uint8_t message;
    const uint8_t *data;
    uint16_t size;
};

// Appends `FA FF message size data sum`, size + 5 bytes; at most 254 bytes of data.
uint8_t write_packet(uint8_t message, const uint8_t *data, uint8_t size, uint8_t *out);

// Finds packets. What starts one may be chance: one with a wrong sum, or with items that do not fit, gives up its first
// byte only, and the search goes on at the next one, so that damage never hides the packets behind it.
class Framer {
  public:
    bool has_room() const { return length_ < sizeof(bytes_); }

    // Only while it has room.
    void push(uint8_t byte) { bytes_[length_++] = byte; }

    // The next whole packet; its data are there until the next call. False: nothing yet, or a false start was given up:
    // no call takes long, so ask again in the next turn of the loop.
    bool next(Packet &packet);

    // The packet handed out last is none: one wrong sum in 256 is right by chance.
    void reject();

    // Starts of packets that were none.
    uint16_t wrong_sums = 0;
    // Bytes of nothing: noise, and what was given up.
    uint32_t skipped_bytes = 0;

  private:
    void drop(uint16_t count);
    void skip_to_preamble(uint16_t from);
    void give_up();

    uint8_t bytes_[6 + MAX_PACKET_DATA_BYTES + 1];
    uint16_t length_ = 0;
    // Of the packet that was handed out last, at the front.
    uint16_t taken_ = 0;
};

struct UtcSaid {
    uint32_t nanosecond;
    uint16_t year;
    uint8_t month, day, hour, minute, second;
};

// What the satellite receiver in the sensor says by itself: item 0x7010, or 0x8830 and 0x8840 of the first firmware.
struct ReceiverSaid {
    bool has_satellites, has_horizontal_dilution, has_std, has_accuracy, has_dilutions;
    bool is_differential;
    uint8_t satellites;
    uint16_t horizontal_dilution_centi;
    // One standard deviation north, east, up.
    uint32_t std_mm[3];
    // Of the position in space; what falls to an axis is in proportion to its dilution.
    uint32_t accuracy_mm;
    // North, east, up, in space.
    uint16_t dilution_centi[4];
};

// What one packet says; without its flag a value is not said.
struct Said {
    bool has_utc, has_counter, has_ticks, has_attitude, has_place, has_height, has_status, has_receiver;
    // Something was said that cannot be.
    bool is_refused;
    UtcSaid utc;
    uint16_t counter;
    // The sensor's own clock, 10 kHz; wraps after five days.
    uint32_t ticks;
    // From north, clockwise, 0 to 359999.
    uint32_t heading_mdeg;
    // Port side up, bow up.
    int16_t roll_cdeg, pitch_cdeg;
    Q32 latitude_deg, longitude_deg;
    // Above the ellipsoid.
    int32_t height_cm;
    uint32_t status;
    ReceiverSaid receiver;
};

// Bits of the status word.
const uint32_t STATUS_FILTER_VALID = (uint32_t)1 << 1;
const uint32_t STATUS_GNSS_FIX = (uint32_t)1 << 2;

// 0: no satellites for long, 1: none for up to 45 s, 3: with satellites.
inline uint8_t filter_mode(uint32_t status) { return status >> 23 & 7; }

// False: an item does not fit its size.
bool parse_measurement(const uint8_t *data, uint16_t size, Said &said);
