/* What a firmware needs of the board that it runs on: linux.c, mps2_an385.c, atmega328p.c, or
 * one of your own. */
#ifndef BOARD_H
#define BOARD_H

#include "blastema_lite.h"

/* Sets the board up. Returns how often it was started, and why this time. */
uint16_t board_begin(int count, char **arguments, uint8_t *cause);
/* Gives the library what was received, and rests for a millisecond at most. */
void board_receive(void);
/* Runs a firmware that keeps nothing of its start: the whole of most mains. */
static inline void board_run(int count, char **arguments) {
    uint8_t cause;
    uint16_t boot = board_begin(count, arguments, &cause);
    bl_begin(boot, cause);
    for (;;) {
        board_receive();
        bl_poll();
    }
}

#endif
