/* An ATmega328P at 16 MHz: its UART at 115,200 baud, its EEPROM, and the watchdog for a reset. */
#include "board.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

/* A frame comes while the one before is worked on. */
#define RING 64u

static uint8_t reset_flags __attribute__((section(".noinit")));
static volatile uint16_t milliseconds;
static volatile uint8_t ring[RING], head, tail;

/* In the first instructions: the watchdog stays on over the reset that it has caused. */
void save_reset_flags(void) __attribute__((naked, used, section(".init3")));
void save_reset_flags(void) {
    reset_flags = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

ISR(TIMER0_COMPA_vect) { milliseconds++; }
ISR(USART_RX_vect) {
    uint8_t byte = UDR0, next = (uint8_t)((head + 1u) % RING);
    if (next == tail) return;
    ring[head] = byte;
    head = next;
}

uint16_t board_begin(int count, char **arguments, uint8_t *cause) {
    uint16_t *cell = 0, boots = eeprom_read_word(cell);
    (void)count, (void)arguments;
    boots = boots == 0xFFFFu ? 1u : (uint16_t)(boots + 1u);
    eeprom_update_word(cell, boots);
    *cause = (reset_flags & _BV(WDRF)) != 0   ? BL_CAUSE_WATCHDOG
             : (reset_flags & _BV(PORF)) != 0 ? BL_CAUSE_POWER_ON /* BORF may be set with it. */
             : (reset_flags & _BV(BORF)) != 0 ? BL_CAUSE_BROWN_OUT
             : (reset_flags & _BV(EXTRF)) != 0 ? BL_CAUSE_EXTERNAL : BL_CAUSE_UNKNOWN;
    UCSR0A = _BV(U2X0);
    UBRR0 = 16;
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
    TCCR0A = _BV(WGM01);
    TCCR0B = _BV(CS01) | _BV(CS00);
    OCR0A = 249;
    TIMSK0 = _BV(OCIE0A);
    SMCR = 0; /* idle */
    sei();
    return boots;
}

void board_receive(void) {
    while (head != tail) {
        uint8_t byte = ring[tail];
        tail = (uint8_t)((tail + 1u) % RING);
        bl_receive(byte);
    }
    /* No byte comes between the question and the rest. */
    cli();
    if (head == tail) {
        sleep_enable();
        sei();
        sleep_cpu();
        sleep_disable();
    }
    sei();
}
void bl_send(const uint8_t *bytes, uint8_t n) {
    while (n-- != 0u) {
        loop_until_bit_is_set(UCSR0A, UDRE0);
        UCSR0A |= _BV(TXC0);
        UDR0 = *bytes++;
    }
}
uint16_t bl_millis(void) {
    uint16_t now;
    cli();
    now = milliseconds;
    sei();
    return now;
}
void bl_restart(void) {
    loop_until_bit_is_set(UCSR0A, TXC0);
    cli();
    wdt_enable(WDTO_15MS);
    for (;;) {}
}
