// The serial lines of the Arduino Mega and its pulse pins, by interrupts.
//
// Not by Arduino's Serial and Serial1: those lose a byte that their 64-byte buffer has no room for without a word, tell
// nothing of overruns and framing errors, and make the program wait when their output buffer is full.
#ifdef __AVR_ATmega2560__

#include "board.h"

#include <Arduino.h>
#include <util/atomic.h>

#include "board_avr.h"

// 115200 baud at 16 MHz and double speed: 117647 in truth, 2.1 % off, within what both ends tolerate. It is what
// Arduino's own library does, and the USB chip of the board does the same.
static const uint16_t UBRR_115200 = 16;

// All lengths are powers of two. 22 ms of the sensor's line at its full speed; a turn of the loop takes 4 ms at
// most, a test counts its cycles.
static volatile uint8_t received[256];
static volatile uint8_t received_head = 0, received_tail = 0;
static volatile uint16_t overruns = 0, framing_errors = 0;
static uint8_t peak_waiting = 0;

// 89 ms of the line to the computer.
static const uint16_t LINES_BYTES = 1024;
static volatile uint8_t lines[LINES_BYTES];
static volatile uint16_t lines_head = 0, lines_tail = 0;

// More than the longest message.
static const uint8_t MESSAGES_BYTES = 128;
static volatile uint8_t messages[MESSAGES_BYTES];
static volatile uint8_t messages_head = 0, messages_tail = 0;

static volatile uint16_t pulses = 0;
static volatile uint32_t pulse_us = 0, pulse_interval_us = 0;

void board_begin() {
    UCSR0A = _BV(U2X0);
    UBRR0 = UBRR_115200;
    UCSR0B = _BV(TXEN0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);

    // A line that nobody drives is quiet.
    pinMode(SENSOR_RECEIVE_PIN, INPUT_PULLUP);
    UCSR1A = _BV(U2X1);
    UBRR1 = UBRR_115200;
    UCSR1B = _BV(RXEN1) | _BV(TXEN1) | _BV(RXCIE1);
    UCSR1C = _BV(UCSZ11) | _BV(UCSZ10);

    pinMode(PULSE_INPUT_PIN, INPUT);
    pinMode(PULSE_OUTPUT_PIN, OUTPUT);
    // Interrupt 4, both edges.
    EICRB = (EICRB & ~_BV(ISC41)) | _BV(ISC40);
    EIMSK |= _BV(INT4);
}

ISR(USART1_RX_vect) {
    uint8_t status = UCSR1A;
    uint8_t byte = UDR1;
    if (status & _BV(DOR1) && overruns != UINT16_MAX) {
        ++overruns;
    }
    if (status & _BV(FE1)) {
        framing_errors += framing_errors != UINT16_MAX;
        return;
    }
    uint8_t head = received_head;
    uint8_t next = head + 1;
    if (next == received_tail) {
        overruns += overruns != UINT16_MAX;
        return;
    }
    received[head] = byte;
    received_head = next;
}

ISR(USART0_UDRE_vect) {
    uint16_t tail = lines_tail;
    if (tail == lines_head) {
        UCSR0B &= ~_BV(UDRIE0);
        return;
    }
    UDR0 = lines[tail];
    lines_tail = (tail + 1) % LINES_BYTES;
}

ISR(USART1_UDRE_vect) {
    uint8_t tail = messages_tail;
    if (tail == messages_head) {
        UCSR1B &= ~_BV(UDRIE1);
        return;
    }
    UDR1 = messages[tail];
    messages_tail = (tail + 1) % MESSAGES_BYTES;
}

// Passes the pulse on, pin 2 (PE4) to pin 3 (PE5), and notes when it began.
ISR(INT4_vect) {
    if (!(PINE & _BV(PE4))) {
        PORTE &= ~_BV(PE5);
        return;
    }
    PORTE |= _BV(PE5);
    uint32_t now_us = micros();
    pulse_interval_us = pulses == 0 ? 0 : now_us - pulse_us;
    pulse_us = now_us;
    pulses += pulses != UINT16_MAX;
}

bool board_read(uint8_t &byte) {
    uint8_t waiting = received_head - received_tail;
    if (waiting == 0) {
        return false;
    }
    if (waiting > peak_waiting) {
        peak_waiting = waiting;
    }
    byte = received[received_tail];
    received_tail = received_tail + 1;
    return true;
}

bool board_send_line(const char *line, uint8_t length, uint16_t keep_free) {
    uint16_t tail;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { tail = lines_tail; }
    uint16_t head = lines_head;
    uint16_t free_bytes = (uint16_t)(tail - head - 1) % LINES_BYTES;
    if (free_bytes < length + keep_free) {
        return false;
    }
    for (uint8_t i = 0; i < length; ++i) {
        lines[head] = line[i];
        head = (head + 1) % LINES_BYTES;
    }
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        lines_head = head;
        UCSR0B |= _BV(UDRIE0);
    }
    return true;
}

void board_send_to_device(const uint8_t *message, uint8_t length) {
    uint8_t head = messages_head;
    uint8_t free_bytes = (uint8_t)(messages_tail - head - 1) % MESSAGES_BYTES;
    if (free_bytes < length) {
        return;
    }
    for (uint8_t i = 0; i < length; ++i) {
        messages[head] = message[i];
        head = (head + 1) % MESSAGES_BYTES;
    }
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        messages_head = head;
        UCSR1B |= _BV(UDRIE1);
    }
}

BoardCounters board_counters() {
    BoardCounters counters;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        counters.overruns = overruns;
        counters.framing_errors = framing_errors;
        counters.pulses = pulses;
        counters.pulse_interval_us = pulse_interval_us;
    }
    counters.peak_waiting = peak_waiting;
    return counters;
}

#endif
