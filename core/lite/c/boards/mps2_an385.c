/* A Cortex-M3 of the board MPS2 with image AN385, as QEMU has it: UART 0, and the file `boots` by
 * semihosting in place of an EEPROM. */
#include "board.h"

#include <string.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART_DATA REGISTER(0x40004000u)
#define UART_STATE REGISTER(0x40004004u)   /* bit 0: the transmitter is full; 1: a byte is there */
#define UART_CONTROL REGISTER(0x40004008u) /* bits 0, 1: transmit, receive; 3: interrupt of it */
#define UART_CLEAR REGISTER(0x4000400Cu)
#define UART_DIVISOR REGISTER(0x40004010u)
#define SYSTICK_CONTROL REGISTER(0xE000E010u)
#define SYSTICK_RELOAD REGISTER(0xE000E014u)
#define INTERRUPTS REGISTER(0xE000E100u)
#define RESET_CONTROL REGISTER(0xE000ED0Cu)
#define CLOCK_HZ 25000000u

extern uint32_t data_image[], data_begin[], data_end[], bss_begin[], bss_end[], stack_end[];
int main(int count, char **arguments);

static volatile uint16_t milliseconds;

static void on_tick(void) { milliseconds++; }
/* It only ends the rest: the byte stays in the UART. */
static void on_receive(void) { UART_CLEAR = 2u; }
static void on_fault(void) { bl_restart(); }

static void on_reset(void) {
    memcpy(data_begin, data_image, (size_t)((char *)data_end - (char *)data_begin));
    memset(bss_begin, 0, (size_t)((char *)bss_end - (char *)bss_begin));
    main(0, 0);
}

typedef void (*vector)(void);
const vector vectors[17] __attribute__((section(".vectors"), used)) = {
    (vector)stack_end, on_reset, on_fault, on_fault, on_fault, on_fault, on_fault,
    [15] = on_tick, [16] = on_receive};

static int32_t semihosting(int32_t operation, const void *arguments) {
    register int32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = arguments;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

/* Opens the file, reads or writes the count, and closes it. */
static void with_boots(uint32_t mode, int32_t operation, uint16_t *boots) {
    static const char name[] = "boots";
    const uint32_t open[3] = {(uint32_t)name, mode, sizeof name - 1u};
    uint32_t file[3] = {0, (uint32_t)boots, sizeof *boots};
    int32_t handle = semihosting(1, open);
    if (handle < 0) return;
    file[0] = (uint32_t)handle;
    (void)semihosting(operation, file);
    (void)semihosting(2, file);
}

uint16_t board_begin(int count, char **arguments, uint8_t *cause) {
    uint16_t boots = 0;
    (void)count, (void)arguments;
    with_boots(1u, 6, &boots); /* "rb", read */
    boots++;
    with_boots(5u, 5, &boots); /* "wb", write */
    *cause = BL_CAUSE_UNKNOWN;
    UART_DIVISOR = CLOCK_HZ / 115200u;
    UART_CONTROL = 0xBu;
    SYSTICK_RELOAD = CLOCK_HZ / 1000u - 1u;
    SYSTICK_CONTROL = 7u;
    INTERRUPTS = 1u;
    return boots;
}

void board_receive(void) {
    while ((UART_STATE & 2u) != 0u) bl_receive((uint8_t)UART_DATA);
    __asm__ volatile("wfi");
}
void bl_send(const uint8_t *bytes, uint8_t n) {
    while (n-- != 0u) {
        while ((UART_STATE & 1u) != 0u) {}
        UART_DATA = *bytes++;
    }
}
uint16_t bl_millis(void) { return milliseconds; }
void bl_restart(void) {
    RESET_CONTROL = 0x05FA0004u;
    for (;;) {}
}
