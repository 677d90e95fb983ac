/* Runs the sketch on an emulated ATmega2560, in step with the test that plays the sensor and the computer.
 *
 *   simavr ELF LOOP-ADDRESS
 *
 * The test and the board take turns, on stdin and stdout, a line each way; bytes are hexadecimal, none is `-`:
 *
 *   run CYCLES BYTES     the sensor sends BYTES, back to back at 115200 baud and after those still under way, while
 *                        CYCLES go by: `SERIAL SERIAL1`, what the sketch has sent to the computer and to the sensor
 *   noise CYCLES BYTES   the same, each byte with its stop bit missing
 *   pulse LEVEL          pin 2 goes to LEVEL, 0 or 1: `ok`
 *   stats                `NAME COUNT NAME COUNT ...`, the longest loop since the last time
 *
 * Pipes in lock-step and not pseudo-terminals, which would let the time of the emulation and that of the host drift
 * apart: so the same input gives the same cycles, however fast the host is.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "avr_ioport.h"
#include "avr_uart.h"
#include "sim_avr.h"
#include "sim_elf.h"
#include "sim_io.h"

enum { FREQUENCY_HZ = 16000000, BYTE_CYCLES = 1389, MAX_BYTES = 1 << 20 };

static avr_t *avr;
static avr_uart_t *serial, *serial1;

/* What a side has sent in this turn. */
struct sent {
    unsigned char bytes[MAX_BYTES];
    size_t count;
};
static struct sent to_computer, to_sensor;

/* What the sensor is sending. */
static uint16_t coming[MAX_BYTES];
static size_t coming_first, coming_count;

static unsigned long overruns, pulses_passed, lamp_changes;

/* Where the sketch's loop() begins, when it began last, and its longest turn. */
static avr_flashaddr_t loop_address;
static avr_cycle_count_t loop_cycle, longest_loop_cycles;

static void note_sent(struct avr_irq_t *irq, uint32_t value, void *param) {
    struct sent *sent = param;
    (void)irq;
    if (sent->count < MAX_BYTES) {
        sent->bytes[sent->count++] = value;
    }
}

static void count_rise(struct avr_irq_t *irq, uint32_t value, void *param) {
    *(unsigned long *)param += value && !irq->value;
}

static void count_change(struct avr_irq_t *irq, uint32_t value, void *param) {
    *(unsigned long *)param += value != irq->value;
}

/* A byte has come in whole. The hardware holds two and a third that is coming in; simavr would hold 64. */
static avr_cycle_count_t next_byte(struct avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)param;
    if (coming_first == coming_count) {
        coming_first = coming_count = 0;
        return 0;
    }
    const uart_fifo_t *waiting = &serial1->input;
    if ((uint8_t)(waiting->write - waiting->read) % uart_fifo_fifo_size > 2) {
        ++overruns;
    } else {
        avr_raise_irq(serial1->io.irq + UART_IRQ_INPUT, coming[coming_first]);
    }
    ++coming_first;
    (void)avr;
    return when + BYTE_CYCLES;
}

static avr_uart_t *find_uart(char name) {
    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        if (strcmp(io->kind, "uart") == 0 && ((avr_uart_t *)io)->name == name) {
            return (avr_uart_t *)io;
        }
    }
    fprintf(stderr, "simavr has no UART %c\n", name);
    exit(1);
}

/* simavr counts a parity bit that is not sent. */
static void mend_byte_time(avr_uart_t *uart) {
    unsigned divider = avr->data[uart->ubrrl.reg] + 1;
    uart->cycles_per_byte = 10 * divider * (avr_regbit_get(avr, uart->u2x) ? 8 : 16);
}

static void run(avr_cycle_count_t cycles, const char *hex, uint16_t flags) {
    int was_quiet = coming_count == 0;
    unsigned byte;
    for (; sscanf(hex, "%2x", &byte) == 1 && coming_count < MAX_BYTES; hex += 2) {
        coming[coming_count++] = byte | flags;
    }
    if (was_quiet && coming_count > 0) {
        avr_cycle_timer_register(avr, BYTE_CYCLES, next_byte, NULL);
    }
    mend_byte_time(serial);
    mend_byte_time(serial1);
    to_computer.count = to_sensor.count = 0;

    for (avr_cycle_count_t end = avr->cycle + cycles; avr->cycle < end;) {
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "the sketch has crashed at %#x\n", (unsigned)avr->pc);
            exit(1);
        }
        if (avr->pc == loop_address) {
            if (loop_cycle && avr->cycle - loop_cycle > longest_loop_cycles) {
                longest_loop_cycles = avr->cycle - loop_cycle;
            }
            loop_cycle = avr->cycle;
        }
    }
}
/* To the test: libsimavr prints to stdout, too. */
static FILE *answers;

static void print_sent(const struct sent *sent, char end) {
    if (sent->count == 0) {
        putc('-', answers);
    }
    for (size_t i = 0; i < sent->count; ++i) {
        fprintf(answers, "%02x", sent->bytes[i]);
    }
    putc(end, answers);
}

int main(int argc, char **argv) {
    answers = fdopen(dup(STDOUT_FILENO), "w");
    dup2(STDERR_FILENO, STDOUT_FILENO);
    elf_firmware_t firmware = {0};
    if (argc != 3 || elf_read_firmware(argv[1], &firmware) != 0) {
        fprintf(stderr, "usage: simavr ELF LOOP-ADDRESS\n");
        return 2;
    }
    loop_address = strtoul(argv[2], NULL, 16);
    avr = avr_make_mcu_by_name("atmega2560");
    avr_init(avr);
    avr->log = LOG_ERROR;
    firmware.frequency = avr->frequency = FREQUENCY_HZ;
    avr_load_firmware(avr, &firmware);

    serial = find_uart('0');
    serial1 = find_uart('1');
    uint32_t no_flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &no_flags);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('1'), &no_flags);
    avr_irq_register_notify(serial->io.irq + UART_IRQ_OUTPUT, note_sent, &to_computer);
    avr_irq_register_notify(serial1->io.irq + UART_IRQ_OUTPUT, note_sent, &to_sensor);
    avr_irq_t *pulse_pin = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('E'), IOPORT_IRQ_PIN4);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('E'), IOPORT_IRQ_PIN5), count_rise,
                            &pulses_passed);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), IOPORT_IRQ_PIN7), count_change,
                            &lamp_changes);

    char *line = NULL;
    size_t capacity = 0;
    while (getline(&line, &capacity, stdin) > 0) {
        unsigned long long cycles;
        int at = 0;
        if (sscanf(line, "run %llu %n", &cycles, &at) == 1 && at > 0) {
            run(cycles, line + at, 0);
        } else if (sscanf(line, "noise %llu %n", &cycles, &at) == 1 && at > 0) {
            run(cycles, line + at, UART_INPUT_FE);
        } else if (strncmp(line, "pulse ", 6) == 0) {
            avr_raise_irq(pulse_pin, line[6] == '1');
            fprintf(answers, "ok\n");
            fflush(answers);
            continue;
        } else if (strcmp(line, "stats\n") == 0) {
            fprintf(answers, "longest_loop_cycles %llu overruns %lu pulses_passed %lu lamp_changes %lu\n",
                    (unsigned long long)longest_loop_cycles, overruns, pulses_passed, lamp_changes);
            longest_loop_cycles = 0;
            fflush(answers);
            continue;
        } else {
            fprintf(stderr, "not understood: %s", line);
            return 2;
        }
        print_sent(&to_computer, ' ');
        print_sent(&to_sensor, '\n');
        fflush(answers);
    }
    return 0;
}
