/* A device for the tests. It adds numbers, and publishes each value that it is given with one more in
 * trace. */
#include "board.h"

#include <string.h>

static devices_value in, taken, out;
static devices_limit limit;
static uint32_t total, calls;
static uint16_t boot;

static uint8_t work(uint8_t why) {
    (void)why;
    if (in.number == 666) return 7;
    if (memcmp(&in, &taken, sizeof in) != 0) {
        taken = in;
        out = in;
        out.trace.item[0]++;
        bl_publish(DEVICES_VALUE_OUT0);
    }
    return 0;
}
static uint8_t aborting(uint8_t why) {
    (void)why;
    memset(&in, 0, sizeof in);
    memset(&taken, 0, sizeof taken);
    return 0;
}

const uint32_t bl_device_type BL_ROM = CHIP_TYPE;
const bl_object bl_objects[BL_OBJECTS] BL_ROM = {
    {.hook = {[BL_ON_EXECUTE] = work, [BL_ON_ABORTING] = aborting}}};
const bl_port bl_ports[BL_PORTS] BL_ROM = {DEVICES_VALUE_IN0(&in), DEVICES_VALUE_OUT0(&out),
                                           DEVICES_ADD_CALL0(0), DEVICES_LIMIT_VARIABLE0(&limit)};

uint8_t bl_call(uint8_t port, uint8_t *data) {
    devices_add add;
    devices_add_reply reply;
    if (port != DEVICES_ADD_CALL0) return 1;
    memcpy(&add, data, sizeof add);
    if (add.amount == 666u) return 1;
    if (add.amount == 667u) bl_restart();
    total += (uint32_t)add.amount;
    reply.total = total;
    reply.calls = ++calls;
    reply.limit = limit.max;
    reply.boots = boot;
    memcpy(data, &reply, sizeof reply);
    return 0;
}
uint8_t bl_text(uint8_t object, uint8_t code, uint8_t *text, uint8_t room) {
    static const char over_travel[] = "over travel";
    if (object != 1u || code != 7u || room < sizeof over_travel - 1u) return 0;
    memcpy(text, over_travel, sizeof over_travel - 1u);
    return sizeof over_travel - 1u;
}

int main(int count, char **arguments) {
    uint8_t cause;
    boot = board_begin(count, arguments, &cause);
    bl_begin(boot, cause);
    for (;;) {
        board_receive();
        bl_poll();
    }
}
