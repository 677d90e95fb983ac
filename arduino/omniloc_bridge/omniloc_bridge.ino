// omniloc bridge: an Arduino Mega 2560 between an Xsens MTi-G-700 and the computer that records.
//
//   sensor (RS-232, 115200 baud) --- MAX3232 --- Serial1: pins 19 (RX1), 18 (TX1)
//   pulse a second of the sensor, optional ----- pin 2; passed on at pin 3
//   computer ----------------------------------- USB: NMEA 0183 lines, 115200 baud
//
// arduino/README.md says how it is wired, flashed, and what the lines and the lamp mean.
//
// Nothing here waits. Interrupts fetch the sensor's bytes and send the lines; the loop takes what has come, one packet a
// turn, and a line that does not fit the queue is dropped whole and counted.

#ifndef __AVR_ATmega2560__
#error "this sketch is for the Arduino Mega 2560: choose it under Tools > Board"
#endif

#include "board_avr.h"
#include "bridge.h"

static Bridge bridge;

// On with a short gap while there is a position, slow while there is none, quick while the sensor says nothing.
static bool lamp(uint32_t now_ms) {
    if (bridge.has_fix(now_ms)) {
        return now_ms % 1024 >= 64;
    }
    return bridge.is_measuring(now_ms) ? now_ms % 1024 < 512 : now_ms % 256 < 128;
}

void setup() {
    board_begin();
    pinMode(LED_BUILTIN, OUTPUT);
}

void loop() {
    uint8_t byte;
    while (bridge.has_room() && board_read(byte)) {
        bridge.push(byte);
    }
    uint32_t now_ms = millis();
    bridge.poll(now_ms);
    digitalWrite(LED_BUILTIN, lamp(now_ms));
}
