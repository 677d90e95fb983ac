// The logic of the sketch on this computer: takes the same lines as simavr.c, and is some thousand times as fast.
//
// Time goes by in steps of one byte on the line: one comes from the sensor, one goes to the computer, one turn of the
// loop. No hardware is emulated: no interrupts, no overruns, no pulse.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <string>

#include "board.h"
#include "bridge.h"

static const unsigned long long BYTE_CYCLES = 1389, CYCLES_PER_MS = 16000;
// As on the board.
static const size_t LINES_BYTES = 1024;

static std::deque<uint8_t> lines, coming;
static std::string to_computer, to_sensor;
static unsigned long long cycle = 0;

static std::string hex(const uint8_t *bytes, size_t count) {
    std::string text;
    for (size_t i = 0; i < count; ++i) {
        char pair[3];
        snprintf(pair, sizeof(pair), "%02x", bytes[i]);
        text += pair;
    }
    return text;
}

bool board_send_line(const char *line, uint8_t length, uint16_t keep_free) {
    if (LINES_BYTES - 1 - lines.size() < size_t(length) + keep_free) {
        return false;
    }
    lines.insert(lines.end(), line, line + length);
    return true;
}

void board_send_to_device(const uint8_t *message, uint8_t length) { to_sensor += hex(message, length); }

BoardCounters board_counters() { return BoardCounters(); }

static void run(Bridge &bridge, unsigned long long cycles) {
    for (unsigned long long end = cycle + cycles; cycle < end; cycle += BYTE_CYCLES) {
        if (!coming.empty() && bridge.has_room()) {
            bridge.push(coming.front());
            coming.pop_front();
        }
        bridge.poll(uint32_t(cycle / CYCLES_PER_MS));
        if (!lines.empty()) {
            to_computer += hex(&lines.front(), 1);
            lines.pop_front();
        }
    }
}

int main() {
    static Bridge bridge;
    char *line = nullptr;
    size_t capacity = 0;
    while (getline(&line, &capacity, stdin) > 0) {
        unsigned long long cycles;
        int at = 0;
        if (sscanf(line, "run %llu %n", &cycles, &at) != 1 || at == 0) {
            fprintf(stderr, "not understood: %s", line);
            return 2;
        }
        unsigned byte;
        for (const char *bytes = line + at; sscanf(bytes, "%2x", &byte) == 1; bytes += 2) {
            coming.push_back(uint8_t(byte));
        }
        run(bridge, cycles);
        printf("%s %s\n", to_computer.empty() ? "-" : to_computer.c_str(), to_sensor.empty() ? "-" : to_sensor.c_str());
        fflush(stdout);
        to_computer.clear();
        to_sensor.clear();
    }
    free(line);
    return 0;
}
