/* A chip on a line: opens the line again when it was away, and gives the chip its bytes.
 *
 *     emulator LINE BOOTS FIRMWARE     BOOTS is the file of its EEPROM
 *
 * With -DSIMAVR, an ATmega328P by libsimavr; else a Cortex-M3 by QEMU, which ends with this process. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <libgen.h>
#include <poll.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static const char *path;
static int line = -1;

/* Returns whether the line is there. */
static int open_line(void) {
    struct termios settings;
    if (line >= 0) return 1;
    line = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (line < 0) return 0;
    if (tcgetattr(line, &settings) == 0) {
        cfmakeraw(&settings);
        cfsetspeed(&settings, B115200);
        tcsetattr(line, TCSANOW, &settings);
    }
    return 1;
}
static ssize_t read_line(uint8_t *bytes, size_t room) {
    ssize_t n = read(line, bytes, room);
    if (n == 0 || (n < 0 && errno != EAGAIN)) {
        close(line);
        line = -1;
    }
    return n;
}

#ifdef SIMAVR
#include <simavr/avr_eeprom.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

#define MHZ 16

static int takes = 1;

static int64_t microseconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000 + now.tv_nsec / 1000;
}

/* Sleeps only when the chip is ahead of the clock, so that it does not fall behind by each rest. */
static void rest(avr_t *chip, avr_cycle_count_t cycles) {
    static int64_t begun;
    int64_t at = (int64_t)(chip->cycle + cycles) / MHZ, ahead = begun + at - microseconds();
    /* It was stopped, or is new: it does not hurry to catch up. */
    if (begun == 0 || ahead < -50000) begun = microseconds() - at;
    if (ahead > 500) {
        struct pollfd bytes = {.fd = takes ? line : -1, .events = POLLIN};
        struct timespec span = {.tv_sec = 0, .tv_nsec = (ahead < 100000 ? ahead : 100000) * 1000};
        ppoll(&bytes, 1, &span, NULL);
    }
}

static void on_xon(struct avr_irq_t *irq, uint32_t value, void *context) {
    (void)irq, (void)value, (void)context;
    takes = 1;
}
static void on_xoff(struct avr_irq_t *irq, uint32_t value, void *context) {
    (void)irq, (void)value, (void)context;
    takes = 0;
}
static void on_byte(struct avr_irq_t *irq, uint32_t value, void *context) {
    uint8_t byte = (uint8_t)value;
    (void)irq, (void)context;
    if (line >= 0 && write(line, &byte, 1) < 0 && errno != EAGAIN) {
        close(line);
        line = -1;
    }
}

int main(int count, char **given) {
    static elf_firmware_t firmware;
    uint8_t cells[2] = {0xFF, 0xFF}, kept[2], bytes[64];
    avr_eeprom_desc_t eeprom = {.ee = cells, .offset = 0, .size = sizeof cells};
    size_t held = 0, given_on = 0;
    uint32_t flags = 0;
    FILE *file;
    avr_t *chip;
    if (count != 4 || elf_read_firmware(given[3], &firmware) != 0) return 1;
    path = given[1];
    chip = avr_make_mcu_by_name("atmega328p");
    if (chip == NULL || avr_init(chip) != 0) return 1;
    firmware.frequency = MHZ * 1000000;
    avr_load_firmware(chip, &firmware);
    chip->sleep = rest;
    if ((file = fopen(given[2], "rb")) != NULL) {
        if (fread(cells, 1, sizeof cells, file) != sizeof cells) return 1;
        fclose(file);
    }
    avr_ioctl(chip, AVR_IOCTL_EEPROM_SET, &eeprom);
    memcpy(kept, cells, sizeof kept);
    /* No output on the terminal; and no rest for each look at the UART's state, with which a frame took a
     * tenth of a second. */
    avr_ioctl(chip, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(chip, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_t *uart = avr_io_getirq(chip, AVR_IOCTL_UART_GETIRQ('0'), 0);
    avr_irq_register_notify(uart + UART_IRQ_OUTPUT, on_byte, NULL);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XON, on_xon, NULL);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XOFF, on_xoff, NULL);
    for (uint32_t turn = 0;; turn++) {
        int state = avr_run(chip);
        if (state == cpu_Done || state == cpu_Crashed) return 1;
        while (takes && given_on < held) avr_raise_irq(uart + UART_IRQ_INPUT, bytes[given_on++]);
        if (turn % 1024 != 0 && state != cpu_Sleeping) continue;
        if (given_on == held && open_line()) {
            ssize_t n = read_line(bytes, sizeof bytes);
            held = n > 0 ? (size_t)n : 0;
            given_on = 0;
        }
        avr_ioctl(chip, AVR_IOCTL_EEPROM_GET, &eeprom);
        if (memcmp(kept, cells, sizeof kept) != 0) {
            if ((file = fopen(given[2], "wb")) == NULL) return 1;
            fwrite(cells, 1, sizeof cells, file);
            fclose(file);
            memcpy(kept, cells, sizeof kept);
        }
    }
}
#else
int main(int count, char **given) {
    int in[2], out[2];
    if (count != 4 || pipe(in) != 0 || pipe(out) != 0) return 1;
    path = given[1];
    pid_t parent = getpid(), child = fork();
    if (child < 0) return 1;
    if (child == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        if (getppid() != parent || chdir(dirname(given[2])) != 0) return 1;
        dup2(in[0], 0);
        dup2(out[1], 1);
        close(in[1]);
        execlp("qemu-system-arm", "qemu-system-arm", "-M", "mps2-an385", "-display", "none",
               "-monitor", "none", "-serial", "stdio", "-semihosting-config",
               "enable=on,target=native", "-kernel", given[3], (char *)NULL);
        return 1;
    }
    close(in[0]);
    close(out[1]);
    for (;;) {
        uint8_t bytes[256];
        struct pollfd ready[2] = {{.fd = out[0], .events = POLLIN}, {.fd = -1, .events = POLLIN}};
        if (open_line()) ready[1].fd = line;
        if (poll(ready, 2, line < 0 ? 10 : 1000) < 0) return 1;
        if (ready[0].revents != 0) {
            ssize_t n = read(out[0], bytes, sizeof bytes);
            if (n <= 0) return 1;
            if (line >= 0 && write(line, bytes, (size_t)n) < 0 && errno != EAGAIN) {
                close(line);
                line = -1;
            }
        }
        if (line >= 0 && ready[1].revents != 0) {
            ssize_t n = read_line(bytes, sizeof bytes);
            if (n > 0 && write(in[1], bytes, (size_t)n) < 0) return 1;
        }
    }
}
#endif
