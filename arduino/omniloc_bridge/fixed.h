// Numbers as the sensor writes them -> fixed point with 32 binary places.
//
// A `double` of the AVR has 32 bits: a latitude in it would step by half a metre. So what the sensor sends as 64-bit
// float is taken apart by its bits, and all arithmetic is in integers.
#pragma once

#include <stdint.h>

// In units of 2^-32: 26 micrometres of a degree of latitude.
typedef int64_t Q32;

const uint64_t Q32_ONE = (uint64_t)1 << 32;

// How a number is written: the low two bits of an item's identifier (Xsens, "MT Low Level Communication Protocol").
enum Precision { F32 = 0, FP1220 = 1, FP1632 = 2, F64 = 3 };

// Bytes of a number.
uint8_t number_bytes(Precision precision);

// Reads a big-endian number. False: not a number, or 2^15 and more, which no angle, latitude or height is.
bool read_number(const uint8_t *bytes, Precision precision, Q32 &value);

inline uint64_t magnitude(Q32 value) { return value < 0 ? -value : value; }

// In steps of 1 / `steps_per_unit`, at most 1000, to the nearest; halves away from zero.
int32_t rounded(Q32 value, uint16_t steps_per_unit);

// An angle of at most 180 degrees in whole degrees and millionths of a minute, 1.9 mm of latitude; without its sign.
void degrees_and_micro_minutes(Q32 value, uint8_t &degrees, uint32_t &micro_minutes);

inline uint16_t read_u16(const uint8_t *bytes) { return (uint16_t)bytes[0] << 8 | bytes[1]; }

inline uint32_t read_u32(const uint8_t *bytes) { return (uint32_t)read_u16(bytes) << 16 | read_u16(bytes + 2); }
