#include "fixed.h"

uint8_t number_bytes(Precision precision) {
    switch (precision) {
    case FP1632:
        return 6;
    case F64:
        return 8;
    default:
        return 4;
    }
}

// mantissa * 2^exponent of a float -> Q32. `exponent` already counts in units of 2^-32.
static Q32 shifted(uint64_t mantissa, int16_t exponent) {
    if (exponent >= 0) {
        return mantissa << exponent;
    }
    if (exponent < -54) { // Mantissas have 53 bits: less than half a step.
        return 0;
    }
    uint8_t shift = -exponent;
    return (mantissa + ((uint64_t)1 << (shift - 1))) >> shift;
}

// IEEE 754: the sign, then the exponent with a bias, then the mantissa without its leading 1. Numbers too small for it
// come out as 0.
static bool read_float(uint64_t bits, uint8_t mantissa_bits, int16_t bias, bool negative, Q32 &value) {
    int16_t biased = bits >> mantissa_bits;
    // 2^15 and more, infinities and NaN.
    if (biased >= bias + 15) {
        return false;
    }
    uint64_t leading = (uint64_t)1 << mantissa_bits;
    uint64_t mantissa = biased == 0 ? 0 : (bits & (leading - 1)) | leading;
    value = shifted(mantissa, biased - bias - mantissa_bits + 32);
    if (negative) {
        value = -value;
    }
    return true;
}

bool read_number(const uint8_t *bytes, Precision precision, Q32 &value) {
    uint32_t high = read_u32(bytes);
    bool negative = high & 0x80000000;
    switch (precision) {
    case F32:
        return read_float(high & 0x7FFFFFFF, 23, 127, negative, value);
    case FP1220:
        value = (Q32)(int32_t)high * ((Q32)1 << 12);
        return true;
    case FP1632: // The fraction comes before the integer part.
        value = (Q32)(int16_t)read_u16(bytes + 4) * (Q32)Q32_ONE + high;
        return true;
    default:
        return read_float((uint64_t)(high & 0x7FFFFFFF) << 32 | read_u32(bytes + 4), 52, 1023, negative, value);
    }
}

// Steps of a fraction (in 2^-32) of at most `steps`, to the nearest.
static uint32_t fraction_steps(uint32_t fraction, uint32_t steps) {
    return ((uint64_t)fraction * steps + 0x80000000) >> 32;
}

int32_t rounded(Q32 value, uint16_t steps_per_unit) {
    uint64_t size = magnitude(value);
    int32_t whole = (int32_t)(size >> 32) * steps_per_unit;
    int32_t steps = whole + (int32_t)fraction_steps((uint32_t)size, steps_per_unit);
    return value < 0 ? -steps : steps;
}

void degrees_and_micro_minutes(Q32 value, uint8_t &degrees, uint32_t &micro_minutes) {
    const uint32_t PER_DEGREE = 60000000;
    uint64_t size = magnitude(value);
    degrees = size >> 32;
    micro_minutes = fraction_steps((uint32_t)size, PER_DEGREE);
    if (micro_minutes == PER_DEGREE) { // 59.9999999 minutes are a degree.
        micro_minutes = 0;
        ++degrees;
    }
}
