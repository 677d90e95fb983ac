// The board, for the sketch itself.
#pragma once

#include <stdint.h>

const uint8_t SENSOR_RECEIVE_PIN = 19;
const uint8_t PULSE_INPUT_PIN = 2;
const uint8_t PULSE_OUTPUT_PIN = 3;

void board_begin();

// The next byte of the sensor; false if none waits.
bool board_read(uint8_t &byte);
