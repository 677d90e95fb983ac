#include "device.h"

#include "board.h"

// Writing its flash memory takes the sensor some of this.
static const uint16_t ANSWER_TIMEOUT_MS = 500;
static const uint8_t MAX_TRIES = 4;
static const uint16_t SILENCE_MS = 1000;
// A sensor that does not answer may only have missed the questions.
static const uint16_t ASK_AGAIN_MS = 10000;

// An entry of the output configuration: identifier, and how often a second.
struct Output {
    uint16_t identifier;
    uint16_t rate_hz;
};

static const uint16_t EVERY_PACKET = 0xFFFF;
static const uint16_t ATTITUDE_HZ = 100;
static const uint16_t POSITION_HZ = 10;
static const uint16_t RECEIVER_HZ = 4;

// What the lines are made of: 54 bytes a packet with time and attitude, 30 more with a position, 97 more with what the
// satellite receiver says, 6088 bytes a second. Attitude in east-north-up, height and place as 64-bit floats.
static const Output OUTPUTS[] = {
    {0x1010, EVERY_PACKET}, {0x1020, EVERY_PACKET}, {0x1060, EVERY_PACKET}, {0x2030, ATTITUDE_HZ},
    {0x5023, POSITION_HZ},  {0x5043, POSITION_HZ},  {0xE020, EVERY_PACKET},
};
// What the satellite receiver says: as the firmware has it now, as that of the first MTi-G-700 had it, not at all.
static const Output NEW_RECEIVER[] = {{0x7010, RECEIVER_HZ}};
static const Output OLD_RECEIVER[] = {{0x8830, RECEIVER_HZ}, {0x8840, RECEIVER_HZ}};

static const struct {
    const Output *outputs;
    uint8_t count;
} RECEIVERS[] = {{NEW_RECEIVER, 1}, {OLD_RECEIVER, 2}, {0, 0}};

static const uint8_t COMMON = sizeof(OUTPUTS) / sizeof(OUTPUTS[0]);
static const uint8_t SETS = sizeof(RECEIVERS) / sizeof(RECEIVERS[0]);
static const uint8_t MAX_OUTPUTS = COMMON + 2;

static uint8_t count_of(uint8_t set) { return COMMON + RECEIVERS[set].count; }

static const Output &output_of(uint8_t set, uint8_t i) {
    return i < COMMON ? OUTPUTS[i] : RECEIVERS[set].outputs[i - COMMON];
}

// Whether a list of outputs, 4 bytes each, has all of a set and nothing else.
static bool is_set(const Packet &packet, uint8_t set) {
    if (packet.size != 4 * count_of(set)) {
        return false;
    }
    for (uint8_t i = 0; i < count_of(set); ++i) {
        const Output &wanted = output_of(set, i);
        bool is_found = false;
        for (uint16_t at = 0; at < packet.size; at += 4) {
            uint16_t rate_hz = read_u16(packet.data + at + 2);
            // How often the time or the receiver comes is up to the sensor.
            bool is_fixed = wanted.rate_hz == ATTITUDE_HZ || wanted.rate_hz == POSITION_HZ;
            bool fits = is_fixed ? rate_hz == wanted.rate_hz : rate_hz != 0;
            is_found |= read_u16(packet.data + at) == wanted.identifier && fits;
        }
        if (!is_found) {
            return false;
        }
    }
    return true;
}

bool Device::is_heard(uint32_t now_ms) const { return has_measured_ && now_ms - measured_ms_ < SILENCE_MS; }

char Device::state(uint32_t now_ms) const {
    if (step_ < MEASURING && has_answered_) {
        return 'C';
    }
    if (!is_heard(now_ms)) {
        return 'S';
    }
    return step_ == MEASURING && is_agreed_ ? 'M' : 'L';
}

void Device::go_to(Step step) {
    step_ = step;
    tries_ = 0;
}

void Device::restart(uint32_t now_ms) {
    losses += step_ >= MEASURING && losses != UINT16_MAX;
    has_answered_ = false;
    outputs_ = 0;
    is_agreed_ = false;
    go_to(ASK_FOR_CONFIG);
    send_request(now_ms);
}

void Device::poll(uint32_t now_ms) {
    if (step_ >= MEASURING) {
        if (!is_heard(now_ms)) {
            restart(now_ms);
        } else if (step_ == LISTENING && now_ms - asked_ms_ >= ASK_AGAIN_MS) {
            send_request(now_ms);
        }
    } else if (tries_ == 0) {
        send_request(now_ms);
    } else if (now_ms - asked_ms_ >= ANSWER_TIMEOUT_MS) {
        no_answer(now_ms);
    }
}

void Device::no_answer(uint32_t now_ms) {
    if (tries_ < MAX_TRIES) {
        send_request(now_ms);
    } else if (is_heard(now_ms)) {
        go_to(LISTENING);
    } else {
        restart(now_ms);
    }
}

uint8_t Device::request_of(Step step) {
    switch (step) {
    case ASK_OUTPUTS:
    case SET_OUTPUTS:
        return OUTPUT_CONFIGURATION;
    case START:
        return GO_TO_MEASUREMENT;
    default:
        return GO_TO_CONFIG;
    }
}

void Device::send_request(uint32_t now_ms) {
    uint8_t data[4 * MAX_OUTPUTS];
    uint8_t size = 0;
    if (step_ == SET_OUTPUTS) {
        for (uint8_t i = 0; i < count_of(outputs_); ++i) {
            const Output &output = output_of(outputs_, i);
            data[size++] = output.identifier >> 8;
            data[size++] = output.identifier;
            data[size++] = output.rate_hz >> 8;
            data[size++] = output.rate_hz;
        }
    }
    uint8_t packet[sizeof(data) + 5];
    board_send_to_device(packet, write_packet(request_of(step_), data, size, packet));
    asked_ms_ = now_ms;
    ++tries_;
}

void Device::message(const Packet &packet, uint32_t now_ms) {
    switch (packet.message) {
    case WAKE_UP: // It has just been switched on.
        restart(now_ms);
        return;
    case GO_TO_CONFIG + 1:
        if (step_ == ASK_FOR_CONFIG || step_ == LISTENING) {
            go_to(ASK_OUTPUTS);
        }
        break;
    case OUTPUT_CONFIGURATION + 1:
        if (step_ == ASK_OUTPUTS) {
            // Without the receiver is as good as we can get only if the sensor refuses more.
            is_agreed_ = is_set(packet, 0) || is_set(packet, 1);
            go_to(is_agreed_ ? START : SET_OUTPUTS);
        } else if (step_ == SET_OUTPUTS) {
            outputs_set(packet);
        }
        break;
    case ERROR:
        if (step_ == SET_OUTPUTS) {
            outputs_set(packet);
        }
        break;
    case GO_TO_MEASUREMENT + 1:
        if (step_ == START) {
            measured(now_ms);
        }
        break;
    default:
        return;
    }
    has_answered_ = true;
}

// The answer is the list that the sensor will send, or an error.
void Device::outputs_set(const Packet &packet) {
    is_agreed_ = packet.message != ERROR && is_set(packet, outputs_);
    if (is_agreed_ || outputs_ + 1 == SETS) {
        go_to(START);
    } else {
        ++outputs_;
        go_to(SET_OUTPUTS);
    }
}

void Device::measured(uint32_t now_ms) {
    measured_ms_ = now_ms;
    has_measured_ = true;
    if (step_ == START) {
        go_to(MEASURING);
    } else if (step_ == ASK_OUTPUTS || step_ == SET_OUTPUTS) {
        // It was switched off and on meanwhile, and understands no configuration.
        restart(now_ms);
    }
}
