/* The device's side of the protocol between a Blastema node and a microcontroller: C99, no heap.
 *
 * The firmware defines the tables and functions of the second part and calls those of the third. A
 * lamp whose brightness the host sets at least every 200 ms, compiled with -DBL_PORTS=2u:
 *
 *     #include "blastema_lite.h"
 *     #pragma pack(push, 1)
 *     typedef struct { uint16_t level; } brightness;
 *     #pragma pack(pop)
 *     static brightness wanted, shown;
 *     static uint8_t off(uint8_t why) { (void)why; pwm(shown.level = 0); return 0; }
 *     static uint8_t work(uint8_t why) {
 *         (void)why;
 *         pwm(shown.level = wanted.level);
 *         bl_publish(1);
 *         return is_hot() ? 1 : 0;
 *     }
 *     const uint32_t bl_device_type BL_ROM = 0x706d616cu;
 *     const bl_object bl_objects[BL_OBJECTS] BL_ROM = {{.hook = {
 *         [BL_ON_EXECUTE] = work, [BL_ON_DEACTIVATED] = off, [BL_ON_ABORTING] = off}}};
 *     const bl_port bl_ports[BL_PORTS] BL_ROM = {
 *         {.object = 1, .id = BL_IN, .data = &wanted, .size = sizeof wanted,
 *          .fingerprint = 0x1234abcdu, .deadline_ms = 200},
 *         {.object = 1, .id = BL_OUT, .data = &shown, .size = sizeof shown,
 *          .fingerprint = 0x1234abcdu}};
 *     void bl_send(const uint8_t *bytes, uint8_t n) { while (n-- != 0u) uart_put(*bytes++); }
 *     uint16_t bl_millis(void) { return milliseconds(); }
 *     uint8_t bl_call(uint8_t port, uint8_t *data) { (void)port; (void)data; return 1; }
 *     uint8_t bl_text(uint8_t object, uint8_t code, uint8_t *text, uint8_t room) {
 *         (void)object; (void)code; (void)text; (void)room;
 *         return 0;
 *     }
 *     void bl_restart(void) { uart_flush(); chip_reset(); }
 *     int main(void) {
 *         board();
 *         bl_begin(next_boot(), reset_cause());
 *         for (;;) {
 *             while (uart_has()) bl_receive(uart_get());
 *             bl_poll();
 *         }
 *     }
 *
 * Hooks run inside bl_receive and bl_poll, so neither may be called from an interrupt; interrupts
 * fill a ring. No other code recovers anything: the host notices a reset, opens a session and
 * brings the objects back to their states. A hook that hangs defeats the dead-man, so a chip that
 * moves something needs its hardware watchdog, and outputs that are safe at reset.
 */
#ifndef BLASTEMA_LITE_H
#define BLASTEMA_LITE_H

#include <stdint.h>

/* A 64-bit floating point number in a struct. Some chips' double has 4 bytes. */
#if defined(__SIZEOF_DOUBLE__) && __SIZEOF_DOUBLE__ == 8
typedef double bl_f64;
#else
typedef struct {
    uint8_t bytes[8];
} bl_f64;
#endif

/* First part: the sizes of this device, from the compiler's command line or a header that it names
 * by -DBL_CONFIG='"gripper.h"'. */

#ifdef BL_CONFIG
#include BL_CONFIG
#endif
#ifndef BL_MAX_DATA
#define BL_MAX_DATA 24u         /* largest struct, and one byte of status; at most 240 */
#endif
#ifndef BL_OBJECTS
#define BL_OBJECTS 1u
#endif
#ifndef BL_PORTS
#define BL_PORTS 1u             /* ports and variables; with the objects at most 255 */
#endif
#ifndef BL_DEADMAN_MAX_MS
#define BL_DEADMAN_MAX_MS 1000u /* the host may ask for less, never for more; at most 60000 */
#endif
/* BL_ADDRESS: an expression for the address on a multi-drop line, 1 to 247.
 * BL_DATAGRAM: packets are datagrams, without COBS; see bl_receive_packet. */

#if BL_DEADMAN_MAX_MS < 1
#error "a dead-man of 0 expires at once"
#endif
#if BL_MAX_DATA > 240 || BL_OBJECTS + BL_PORTS > 255 || BL_DEADMAN_MAX_MS > 60000
#error "a size of this device is larger than the protocol allows"
#endif
#if BL_OBJECTS < 1 || BL_PORTS < 1
#error "a device has at least one object and one port; a variable will do"
#endif
#if BL_MAX_DATA < BL_OBJECTS + 10
#error "BL_MAX_DATA must hold the reply to HELLO: 10 bytes, and one for each object"
#endif
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "structs travel in little-endian order"
#endif

#ifdef __AVR__
#include <avr/pgmspace.h>
#define BL_ROM PROGMEM
#define BL_ROM_U8(p) pgm_read_byte(p)
#define BL_ROM_COPY(to, from, n) memcpy_P((to), (from), (n))
#else
#define BL_ROM
#define BL_ROM_U8(p) (*(const uint8_t *)(p))
#define BL_ROM_COPY(to, from, n) memcpy((to), (from), (n))
#endif

enum { BL_ON_INITIALIZE, BL_ON_ACTIVATED, BL_ON_EXECUTE, BL_ON_DEACTIVATED,
       BL_ON_ABORTING, BL_ON_ERROR, BL_ON_RESET, BL_ON_FINALIZE, BL_HOOKS };
enum { BL_CREATED, BL_INACTIVE, BL_ACTIVE, BL_ERROR, BL_FINALIZED };
enum { BL_CAUSE_UNKNOWN, BL_CAUSE_POWER_ON, BL_CAUSE_EXTERNAL, BL_CAUSE_BROWN_OUT,
       BL_CAUSE_WATCHDOG, BL_CAUSE_SOFTWARE, BL_CAUSE_FAULT_HANDLER };
enum { BL_IN = 0x40, BL_OUT = 0x60, BL_CALL = 0x80, BL_VARIABLE = 0xC0 };
enum { BL_INPUT_TOO_OLD = 0xFD, BL_DEADMAN = 0xFE };

/* A hook; null in the table if there is nothing to do. The result is 0, or the code of a fault, 1
 * to 0xEF, which leads by way of BL_ON_ABORTING to BL_ERROR. `why` is that code in BL_ON_ABORTING,
 * which must set safe outputs, and in BL_ON_ERROR; 0 in the others. */
typedef uint8_t (*bl_hook)(uint8_t why);

typedef struct {
    bl_hook hook[BL_HOOKS];
} bl_object;

typedef struct {
    void *data;            /* the packed struct; null for calls alone */
    uint32_t fingerprint;  /* of the packed layout: the number that the host has for this port */
    uint16_t deadline_ms;  /* in ports: the oldest value that an active object works with, at most
                            * 60000; 0: any */
    uint8_t object;        /* from 1 */
    uint8_t id;            /* BL_IN, BL_OUT, BL_CALL or BL_VARIABLE, plus a number */
    uint8_t size;          /* of the struct; of the arguments of a call */
    uint8_t reply;         /* size of a call's result */
} bl_port;

/* Second part: what the firmware gives, all of it. The tables are BL_ROM. */

extern const bl_object bl_objects[BL_OBJECTS];
extern const bl_port bl_ports[BL_PORTS];
extern const uint32_t bl_device_type;

/* Sends bytes, at once or by a queue. A frame comes in pieces, some of them empty; a datagram in
 * one. On RS-485, the first byte leaves not before one character time after the last received. */
void bl_send(const uint8_t *bytes, uint8_t count);
/* Milliseconds since any time; wraps. */
uint16_t bl_millis(void);
/* Carries out the call with this index in bl_ports: `data` holds the arguments and takes the
 * result. 0 if all is well. */
uint8_t bl_call(uint8_t port, uint8_t *data);
/* Writes the text of an object's code, of at most `room` bytes; returns their number. */
uint8_t bl_text(uint8_t object, uint8_t code, uint8_t *text, uint8_t room);
/* Resets the chip, after the bytes that were given to bl_send have left. */
void bl_restart(void);

/* Third part: what the firmware calls. */

/* Starts: runs BL_ON_INITIALIZE. `boot` counts the starts, 0 if the chip cannot. */
void bl_begin(uint16_t boot, uint8_t cause);
#ifdef BL_DATAGRAM
/* Takes one datagram. The firmware drops those of more than 255 bytes. */
void bl_receive_packet(const uint8_t *bytes, uint8_t count);
#else
/* Takes one received byte. */
void bl_receive(uint8_t byte);
#endif
/* Does what is due: dead-man, deadlines, BL_ON_EXECUTE. At least once a millisecond. */
void bl_poll(void);
/* Sends the struct of the out port with this index in bl_ports; on a multi-drop line when the host
 * asks, with its value of then. */
void bl_publish(uint8_t port);
/* The state of an object, from 1. */
uint8_t bl_state(uint8_t object);

#endif
