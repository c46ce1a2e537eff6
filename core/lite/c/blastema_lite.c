/* The device's side, for the header beside it. The same machine as src/device.rs. */
#include "blastema_lite.h"

#include <string.h>

enum { OK, WRONG_STATE, NO_SUCH, WRONG_LENGTH, HOOK_FAILED, NO_SESSION, END, OUT_OF_STEP };
enum { PING, HELLO, DESCRIBE, POLL, RESTART };
enum { LIFECYCLE = 0x10, START = 0x14, STOP = 0x15, RATE = 0x16, STATE = 0x20, TEXT = 0x21 };
enum { GET = 0xE0, GET_BIT = 0x20, PING_PROBE = 0x80, UNKNOWN = 0xFF };
/* bits of the header and of a PONG's flags */
enum { PLAIN_TEXT = 0x40, FROM_DEVICE = 0x20, COMMAND = 0x10, WIDE = 8, SEQUENCE = 7 };
enum { HAS_SESSION = 1, DEADMAN_EXPIRED = 2, WAITING = 4, ONE_FAULT = 0x10 };

#ifdef BL_ADDRESS
#define HEAD 1u                         /* where the header stands */
#else
#define HEAD 0u
#endif
#define DATA (HEAD + 3u)
#define PACKET (DATA + BL_MAX_DATA + 2u)
#define TEXT_ROOM (BL_MAX_DATA > 32u ? 32u : BL_MAX_DATA - 1u)
#define PERIOD_MAX_MS 60000u            /* bl_millis wraps later */
#define EVENTS (BL_OBJECTS + BL_PORTS)  /* STATE of each object, then DATA of each port */

static struct {
    uint8_t rx[PACKET];                 /* what is received; then the answer to a link message */
    uint8_t tx[PACKET];                 /* the reply to the last command */
#ifndef BL_DATAGRAM
    uint8_t rx_length, started, left, overlong;
#endif
    uint8_t tx_length;
    uint8_t last, flags, cause, silent, stopped;
    uint16_t session, boot, received, deadman, period, executed;
    uint8_t state[BL_OBJECTS], fault[BL_OBJECTS];
    uint16_t written[BL_PORTS];
#ifdef BL_ADDRESS
    uint8_t waiting[(EVENTS + 7u) / 8u];
#endif
} s;

/* The start value and the final XOR are part of the error detection: without the latter, a packet
 * that ends in a zero passes when noise has cut that zero off. */
static uint16_t checksum(const uint8_t *p, uint8_t n, uint16_t value, uint8_t wide) {
    uint16_t polynomial = wide != 0u ? 0x5935u : 0x2F00u;
    while (n-- != 0u) {
        uint8_t i = 8;
        value = (uint16_t)(value ^ ((uint16_t)*p++ << 8));
        while (i-- != 0u) {
            uint16_t top = value & 0x8000u;
            value = (uint16_t)(value << 1);
            if (top != 0u) value ^= polynomial;
        }
    }
    return (uint16_t)~value;
}

/* PING and PONG have CRC-8. Noise may have turned the bit of the header. */
static uint8_t is_wide(const uint8_t *p) {
    return (p[HEAD + 1u] | p[HEAD + 2u]) != 0u ? WIDE : 0u;
}

static uint16_t checksum_of(const uint8_t *p, uint8_t n) {
    return checksum(p, n, p[HEAD + 1u] == 0u ? 0xFFFFu : s.session, is_wide(p));
}

static void transmit(const uint8_t *p, uint8_t n) {
#ifdef BL_DATAGRAM
    bl_send(p, n);
#else
    const uint8_t delimiter = 0;
    for (;;) {
        uint8_t run = 0, code;
        while (run < n && p[run] != 0u) run++;  /* a packet is shorter than 254 bytes */
        code = (uint8_t)(run + 1u);
        bl_send(&code, 1);
        bl_send(p, run);
        if (run == n) break;
        p += code;
        n = (uint8_t)(n - code);
    }
    bl_send(&delimiter, 1);
#endif
}

/* Completes and sends a packet of `n` bytes without its checksum, which begins at `p`. Of its
 * header, the class and sequence are there. */
static void finish(uint8_t *p, uint8_t n) {
    uint16_t sum;
    uint8_t wide = is_wide(p);
#ifdef BL_ADDRESS
    p[0] = BL_ADDRESS;
#endif
    p[HEAD] = (uint8_t)((p[HEAD] & (COMMAND | SEQUENCE)) | PLAIN_TEXT | FROM_DEVICE | wide);
    sum = checksum_of(p, n);
    p[n++] = (uint8_t)(sum >> 8);
    if (wide != 0u) p[n++] = (uint8_t)sum;
    transmit(p, n);
}

static void send_event(uint8_t event) {
    uint8_t p[PACKET], n = 2;
    p[HEAD] = 0;
    p[HEAD + 1u] = (uint8_t)(event + 1u);
    p[HEAD + 2u] = STATE;
    if (event < BL_OBJECTS) {
        p[DATA] = s.state[event];
        p[DATA + 1u] = s.fault[event];
    } else {
        bl_port port;
        BL_ROM_COPY(&port, &bl_ports[event - BL_OBJECTS], sizeof port);
        p[HEAD + 1u] = port.object;
        p[HEAD + 2u] = port.id;
        n = port.size;
        memcpy(&p[DATA], port.data, n);
    }
    finish(p, (uint8_t)(DATA + n));
}

/* On a multi-drop line events wait for POLL. */
static void report(uint8_t event) {
#ifdef BL_ADDRESS
    uint8_t *byte = &s.waiting[event >> 3];
    *byte = (uint8_t)(*byte | (1u << (event & 7u)));
#else
    if (s.session != 0u) send_event(event);
#endif
}

#ifdef BL_ADDRESS
/* Sends so many of the waiting events at most; returns the flag of those that still wait. */
static uint8_t send_waiting(uint8_t most) {
    uint8_t event;
    for (event = 0; event < EVENTS; event++) {
        uint8_t *byte = &s.waiting[event >> 3], bit = (uint8_t)(1u << (event & 7u));
        if ((*byte & bit) == 0u) continue;
        if (most-- == 0u || s.session == 0u) return WAITING;
        *byte = (uint8_t)(*byte & ~bit);
        send_event(event);
    }
    return 0;
}
#endif

static uint8_t call_hook(uint8_t object, uint8_t which, uint8_t why) {
    bl_hook hook;
    BL_ROM_COPY(&hook, &bl_objects[object].hook[which], sizeof hook);
    return hook != 0 ? hook(why) : (uint8_t)0;
}

static void abort_object(uint8_t object, uint8_t why) {
    s.state[object] = BL_ERROR;
    s.fault[object] = why;
    s.flags = (uint8_t)(s.flags + ONE_FAULT);
    (void)call_hook(object, BL_ON_ABORTING, why);
    report(object);
}

static uint8_t change(uint8_t object, uint8_t what) {
    static const uint8_t changes[4][3] BL_ROM = { /* from, hook, to */
        {BL_INACTIVE, BL_ON_ACTIVATED, BL_ACTIVE}, {BL_ACTIVE, BL_ON_DEACTIVATED, BL_INACTIVE},
        {BL_ERROR, BL_ON_RESET, BL_INACTIVE}, {BL_INACTIVE, BL_ON_FINALIZE, BL_FINALIZED}};
    const uint8_t *row = changes[what];
    uint8_t why, i;
    if (s.state[object] != BL_ROM_U8(&row[0])) return WRONG_STATE;
    why = call_hook(object, BL_ROM_U8(&row[1]), 0);
    if (why != 0u) {
        abort_object(object, why);
        return HOOK_FAILED;
    }
    s.fault[object] = 0;
    s.state[object] = BL_ROM_U8(&row[2]);
    /* the age of inputs counts from the activation */
    for (i = 0; i < BL_PORTS; i++)
        if (BL_ROM_U8(&bl_ports[i].object) == object + 1u) s.written[i] = bl_millis();
    return OK;
}

static uint16_t u16(const uint8_t *p) {
    return (uint16_t)(p[0] | (uint16_t)((uint16_t)p[1] << 8));
}

static uint16_t within(uint16_t value, uint16_t most) {
    return value < most ? value : most;
}

/* The index of the port that a message concerns; UNKNOWN if there is none. */
static uint8_t find(bl_port *port, uint8_t object, uint8_t message) {
    uint8_t i;
    if (message >= GET) message = (uint8_t)(message & ~GET_BIT);
    for (i = 0; i < BL_PORTS; i++) {
        if (BL_ROM_U8(&bl_ports[i].object) == object && BL_ROM_U8(&bl_ports[i].id) == message) {
            BL_ROM_COPY(port, &bl_ports[i], sizeof *port);
            return i;
        }
    }
    return UNKNOWN;
}

static void write_port(const bl_port *port, uint8_t index, const uint8_t *data) {
    s.written[index] = s.received;
    memcpy(port->data, data, port->size);
}

static uint8_t is_call(uint8_t message) {
    return (message & 0xC0u) == BL_CALL;
}

/* READ and GET */
static uint8_t is_read(uint8_t message) {
    return (message & GET_BIT) != 0u && is_call(message) == 0u;
}

/* Data of another length than the message's are a sign of noise that the checksum has missed. Only
 * an unknown message passes, to be answered. */
static uint8_t has_exact_length(uint8_t message, uint8_t n, uint8_t index, const bl_port *port) {
    if (message >= LIFECYCLE && message <= STOP) return n == 0u;
    if (message == RATE) return n == 2u;
    if (message == TEXT) return n == 1u;
    return index == UNKNOWN || n == (is_read(message) != 0u ? 0u : port->size);
}

/* Carries out what is in rx; writes status and data to `out` and returns their number. */
static uint8_t execute(uint8_t object, uint8_t message, uint8_t index, const bl_port *port,
                       uint8_t *out) {
    const uint8_t *data = &s.rx[DATA];
    uint8_t i = (uint8_t)(object - 1u);
    out[0] = OK;
    if (i >= BL_OBJECTS) {
        out[0] = NO_SUCH;
    } else if (message >= LIFECYCLE && message < START) {
        out[0] = change(i, (uint8_t)(message - LIFECYCLE));
        out[1] = s.state[i];
        return 2;
    } else if (message >= START && message <= RATE) {
        if (message == RATE) s.period = u16(data) == 0u ? 1u : within(u16(data), PERIOD_MAX_MS);
        else s.stopped = message == STOP;
        s.executed = s.received;
    } else if (message == TEXT) {
        return (uint8_t)(1u + bl_text(object, data[0], &out[1], TEXT_ROOM));
    } else if (index == UNKNOWN) {
        out[0] = NO_SUCH;
    } else if (is_call(message) != 0u) {
        memcpy(&out[1], data, port->size);
        if (bl_call(index, &out[1]) == 0u) return (uint8_t)(1u + port->reply);
        out[0] = HOOK_FAILED;
    } else if (is_read(message) == 0u) {
        write_port(port, index, data);
    } else {
        memcpy(&out[1], port->data, port->size);
        return (uint8_t)(1u + port->size);
    }
    return 1;
}

static void command(uint8_t n) {
    uint8_t sequence = s.rx[HEAD] & SEQUENCE, object = s.rx[HEAD + 1u], message = s.rx[HEAD + 2u];
    bl_port port = {0};
    uint8_t index = find(&port, object, message);
    if (has_exact_length(message, n, index, &port) == 0u) return;
    if (sequence == s.last && s.tx_length != 0u) {
        finish(s.tx, s.tx_length);
    } else if (sequence == ((s.last + 1u) & SEQUENCE)) {
        s.last = sequence;
        memcpy(s.tx, s.rx, DATA);
        s.tx_length = (uint8_t)(DATA + execute(object, message, index, &port, &s.tx[DATA]));
        finish(s.tx, s.tx_length);
    } else {
        s.rx[DATA] = OUT_OF_STEP;
        finish(s.rx, DATA + 1u);
    }
}

static uint8_t hello(uint8_t *data) {
    uint16_t session = u16(data);
    if (session == 0u) return 0;
    if (session != s.session) {
        s.session = session;
        s.last = 0;
        s.tx_length = 0;
        s.flags = (uint8_t)(s.flags & ~DEADMAN_EXPIRED);
    }
    s.deadman = u16(&data[2]);
    s.deadman = s.deadman == 0u ? BL_DEADMAN_MAX_MS : within(s.deadman, BL_DEADMAN_MAX_MS);
    data[1] = (uint8_t)s.boot;
    data[2] = (uint8_t)(s.boot >> 8);
    data[3] = s.cause;
    BL_ROM_COPY(&data[4], &bl_device_type, 4);
    data[8] = BL_MAX_DATA;
    data[9] = BL_OBJECTS;
    memcpy(&data[10], s.state, BL_OBJECTS);
    return 10u + BL_OBJECTS;
}

static uint8_t describe(uint8_t *data) {
    bl_port port;
    data[1] = END;
    if (data[0] >= BL_PORTS) return 2;
    BL_ROM_COPY(&port, &bl_ports[data[0]], sizeof port);
    data[1] = port.object;
    data[2] = port.id;
    data[3] = port.size;
    memcpy(&data[4], &port.fingerprint, 4);
    return 8;
}

/* Answers in rx, whose data have `n` bytes, behind the first one; returns the number of the
 * answer's, 0 for no answer. */
static uint8_t link_message(uint8_t message, uint8_t n, uint8_t *data) {
    if (message == HELLO && n == 4u) return hello(data);
    if (message == DESCRIBE && n == 1u) return describe(data);
    if (message == RESTART && n == 4u) {
        uint32_t type;
        BL_ROM_COPY(&type, &bl_device_type, sizeof type);
        data[1] = memcmp(data, &type, sizeof type) == 0 ? OK : NO_SUCH;
        return 2;
    }
#ifdef BL_ADDRESS
    if (message == POLL) {
        if (n != 1u || s.rx[0] == 0u) return 0; /* not all at once */
        s.rx[HEAD + 2u] = PING;
        (void)send_waiting(data[0]);
    } else
#endif
    if (message != PING || n != 1u) return 0;
    data[1] = (uint8_t)s.boot;
    data[2] = (uint8_t)(s.flags | (s.session != 0u ? HAS_SESSION : 0u));
#ifdef BL_ADDRESS
    data[2] = (uint8_t)(data[2] | send_waiting(0));
#endif
    data[3] = (uint8_t)s.session;
    return 4;
}

/* Acts on the packet of `n` bytes in rx. */
static void take(uint8_t n) {
    uint8_t *p = &s.rx[HEAD], wide, tail, message, answered = 1;
    uint16_t sum;
    if (n < DATA) return;
    wide = is_wide(s.rx);
    if ((p[0] & ~(COMMAND | SEQUENCE)) != (PLAIN_TEXT | wide)) return;
    if ((p[0] & COMMAND) == 0u && (p[0] & SEQUENCE) != 0u) return;
#ifdef BL_ADDRESS
    /* packets to all are never answered, so no command can go to all */
    answered = s.rx[0] == (BL_ADDRESS);
    if (answered == 0u && (s.rx[0] != 0u || (p[0] & COMMAND) != 0u)) return;
#endif
    tail = wide != 0u ? 2u : 1u;
    if (n < DATA + tail) return;
    if (p[1] == 0u ? (p[0] & COMMAND) != 0u : s.session == 0u) return;
    n = (uint8_t)(n - tail);
    sum = checksum_of(s.rx, n);
    if (s.rx[n] != (uint8_t)(sum >> 8) || (wide != 0u && s.rx[n + 1u] != (uint8_t)sum)) return;
    n = (uint8_t)(n - DATA);
    message = p[2];
    /* a host that does not serve this device must not restart the dead-man */
    if (wide != 0u || n == 0u || p[3] < PING_PROBE) {
        s.received = bl_millis();
        s.silent = 0;
    }
    if ((p[0] & COMMAND) != 0u) {
        command(n);
    } else if (p[1] == 0u) {
        n = link_message(message, n, &p[3]);
        if (n == 0u || answered == 0u) return;
        finish(s.rx, (uint8_t)(DATA + n));
        if (message == RESTART && p[4] == OK) bl_restart();
    } else {
        bl_port port;               /* plain: the newest value wins, and nothing is answered */
        uint8_t index = find(&port, p[1], message);
        if (index != UNKNOWN && port.id < BL_OUT && n == port.size) write_port(&port, index, &p[3]);
    }
}

#ifdef BL_DATAGRAM
void bl_receive_packet(const uint8_t *bytes, uint8_t count) {
    if (count > PACKET) return;
    memcpy(s.rx, bytes, count);
    take(count);
}
#else
void bl_receive(uint8_t byte) {
    if (byte == 0u) {
        uint8_t n = s.rx_length;
        if (s.overlong != 0u || s.left != 0u) n = 0;
        s.rx_length = s.left = s.overlong = s.started = 0;
        take(n);
        return;
    }
    if (s.left == 0u) {
        s.left = (uint8_t)(byte - 1u);
        byte = 0;                   /* between two blocks there is a zero of the packet */
        if (s.started == 0u) {
            s.started = 1;
            return;
        }
    } else {
        s.left--;
    }
    if (s.rx_length == PACKET) s.overlong = 1;
    else s.rx[s.rx_length++] = byte;
}
#endif

void bl_begin(uint16_t boot, uint8_t cause) {
    uint8_t i;
    memset(&s, 0, sizeof s);
    s.boot = boot;
    s.cause = cause;
    s.period = 10;
    s.executed = bl_millis();
    for (i = 0; i < BL_OBJECTS; i++) {
        s.fault[i] = call_hook(i, BL_ON_INITIALIZE, 0);
        s.state[i] = s.fault[i] == 0u ? BL_INACTIVE : BL_FINALIZED;
    }
}

void bl_poll(void) {
    uint16_t now = bl_millis();
    uint8_t i, why;
    if (s.session != 0u && s.silent == 0u && (uint16_t)(now - s.received) >= s.deadman) {
        s.silent = 1;
        s.flags = (uint8_t)(s.flags | DEADMAN_EXPIRED);
        for (i = 0; i < BL_OBJECTS; i++)
            if (s.state[i] == BL_ACTIVE) abort_object(i, BL_DEADMAN);
    }
    for (i = 0; i < BL_PORTS; i++) {
        bl_port port;
        BL_ROM_COPY(&port, &bl_ports[i], sizeof port);
        if (port.deadline_ms != 0u && s.state[port.object - 1u] == BL_ACTIVE
            && (uint16_t)(now - s.written[i]) >= port.deadline_ms)
            abort_object((uint8_t)(port.object - 1u), BL_INPUT_TOO_OLD);
    }
    if (s.stopped != 0u || (uint16_t)(now - s.executed) < s.period) return;
    s.executed = (uint16_t)(s.executed + s.period);
    if ((uint16_t)(now - s.executed) >= s.period) s.executed = now; /* missed ones are skipped */
    for (i = 0; i < BL_OBJECTS; i++) {
        if (s.state[i] == BL_ACTIVE) {
            why = call_hook(i, BL_ON_EXECUTE, 0);
            if (why != 0u) abort_object(i, why);
        } else if (s.state[i] == BL_ERROR) {
            (void)call_hook(i, BL_ON_ERROR, s.fault[i]);
        }
    }
}

void bl_publish(uint8_t port) {
    report((uint8_t)(BL_OBJECTS + port));
}

uint8_t bl_state(uint8_t object) {
    return s.state[object - 1u];
}
