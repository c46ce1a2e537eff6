/* The firmware of a gripper: it closes with the force that it is told, 80 mm to 30 mm. */
#include "board.h"

static hand_close wanted;
static hand_grip shown = {.width = 80};

static uint8_t release(uint8_t why) {
    (void)why;
    wanted.force = 0; /* also when the node falls silent */
    return 0;
}
static uint8_t work(uint8_t why) {
    (void)why;
    if (wanted.force > 0 && shown.width > 30u) shown.width = (uint16_t)(shown.width - 5u);
    if (wanted.force <= 0 && shown.width < 80u) shown.width = (uint16_t)(shown.width + 5u);
    shown.holds = shown.width == 30u;
    bl_publish(HAND_GRIP_OUT0);
    return 0;
}

const uint32_t bl_device_type BL_ROM = GRIPPER_TYPE;
const bl_object bl_objects[BL_OBJECTS] BL_ROM = {{.hook = {
    [BL_ON_EXECUTE] = work, [BL_ON_DEACTIVATED] = release, [BL_ON_ABORTING] = release}}};
const bl_port bl_ports[BL_PORTS] BL_ROM = {HAND_CLOSE_IN0(&wanted), HAND_GRIP_OUT0(&shown)};

uint8_t bl_call(uint8_t port, uint8_t *data) { (void)port, (void)data; return 1; }
uint8_t bl_text(uint8_t object, uint8_t code, uint8_t *text, uint8_t room) {
    (void)object, (void)code, (void)text, (void)room;
    return 0;
}

int main(int count, char **arguments) { board_run(count, arguments); }
