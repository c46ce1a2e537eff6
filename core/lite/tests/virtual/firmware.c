/* The firmware of the conformance suite, as a process. It reads requests from its standard input:
 * operation, time in milliseconds, number of bytes, bytes; and answers with each piece that it
 * sends behind its length, and a zero. */
#include "blastema_lite.h"

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#ifdef NAIVE_DOUBLE
typedef float level; /* what a tool chain with a short double makes of the contract */
#else
typedef bl_f64 level;
#endif

#pragma pack(push, 1)
typedef struct {
    int16_t force;
    level level;
} drive;
typedef struct {
    uint32_t executed, twice, wrong;
    uint8_t aborted;
} journal_entry;
#pragma pack(pop)

static drive in, out;
static uint16_t limit;
static uint8_t steer, count, cause;
static journal_entry journal;
static uint32_t last;
static uint32_t now;
static uint16_t boot;

static uint8_t activated(uint8_t why) {
    (void)why;
    memset(&in, 0, sizeof in);
    memset(&out, 0, sizeof out);
    return limit == 666u ? 9 : 0;
}
static uint8_t work(uint8_t why) {
    (void)why;
    if (in.force == 666) return 7;
    if (memcmp(&in, &out, sizeof in) != 0) {
        out = in;
        bl_publish(1);
    }
    return 0;
}
static uint8_t aborting(uint8_t why) {
    journal.aborted = why;
    return 0;
}
static uint8_t reset(uint8_t why) {
    (void)why;
    return limit == 667u ? 8 : 0;
}
static uint8_t initialize(uint8_t why) {
    (void)why;
    return cause == BL_CAUSE_FAULT_HANDLER ? 5 : 0;
}
static uint8_t count_up(uint8_t why) {
    (void)why;
    count++;
    bl_publish(5);
    return 0;
}

const uint32_t bl_device_type BL_ROM = 0x6f686365u;
const bl_object bl_objects[BL_OBJECTS] BL_ROM = {
    {{0, activated, work, 0, aborting, 0, reset, 0}},
    {{initialize, 0, count_up, 0, aborting, 0, 0, 0}}};
const bl_port bl_ports[BL_PORTS] BL_ROM = {
    {&in, 0x1234abcdu, 0, 1, BL_IN, sizeof in, 0},
    {&out, 0x1234abcdu, 0, 1, BL_OUT, sizeof out, 0},
    {0, 0x55aa55aau, 0, 1, BL_CALL, 4, 8},
    {&limit, 3, 0, 1, BL_VARIABLE, sizeof limit, 0},
    {&steer, 4, 50, 2, BL_IN, sizeof steer, 0},
    {&count, 5, 0, 2, BL_OUT, sizeof count, 0},
    {0, 6, 0, 2, BL_CALL, 0, 0},
    {&journal, 7, 0, 2, BL_VARIABLE, sizeof journal, 0}};

static void answer(const void *bytes, size_t n) {
    static uint8_t buffer[65536];
    static size_t used;
    if (used + n > sizeof buffer) abort();
    memcpy(&buffer[used], bytes, n);
    used += n;
    if (n == 1u && buffer[used - 1u] == 0u) {
        size_t at = 0;
        while (at < used) {
            ssize_t written = write(1, &buffer[at], used - at);
            if (written <= 0) exit(0);
            at += (size_t)written;
        }
        used = 0;
    }
}
void bl_send(const uint8_t *bytes, uint8_t n) {
    uint8_t piece[256];
    if (n == 0u) return;
    piece[0] = n;
    memcpy(&piece[1], bytes, n);
    answer(piece, n + 1u);
}
uint16_t bl_millis(void) { return (uint16_t)now; }
uint8_t bl_call(uint8_t port, uint8_t *data) {
    uint32_t argument;
    if (port == 6u) return 1;
    memcpy(&argument, data, 4);
    journal.executed++;
    if (argument == last) journal.twice++;
    else if (argument != last + 1u) journal.wrong++;
    last = argument;
    memcpy(data, &journal.executed, 4);
    memcpy(data + 4, &argument, 4);
    return 0;
}
uint8_t bl_text(uint8_t object, uint8_t code, uint8_t *text, uint8_t room) {
    static const char over_travel[] = "over travel";
    if (object != 1u || code != 7u || room < sizeof over_travel - 1u) return 0;
    memcpy(text, over_travel, sizeof over_travel - 1u);
    return sizeof over_travel - 1u;
}
static void start(uint8_t why) {
    cause = why;
    limit = 0;
    count = 0;
    bl_begin(++boot, cause);
}
void bl_restart(void) { start(BL_CAUSE_SOFTWARE); }

static void take(void *bytes, size_t n) {
    size_t at = 0;
    while (at < n) {
        ssize_t got = read(0, (uint8_t *)bytes + at, n - at);
        if (got <= 0) exit(0);
        at += (size_t)got;
    }
}

int main(void) {
    static uint8_t bytes[65536];
    const uint8_t end = 0;
    for (;;) {
        uint8_t operation;
        uint16_t n;
        take(&operation, 1);
        take(&now, 4);
        take(&n, 2);
        take(bytes, n);
        if (operation != 0u) {
            start(bytes[0]);
        } else {
#ifdef BL_DATAGRAM
            if (n != 0u && n < 256u) bl_receive_packet(bytes, (uint8_t)n);
#else
            size_t i;
            for (i = 0; i < n; i++) bl_receive(bytes[i]);
#endif
            bl_poll();
        }
        answer(&end, 1);
    }
}
