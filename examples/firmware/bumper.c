/* The firmware of a bumper: it is touched for a second in every two, as this board has no switch. */
#include "board.h"

static bumper_contact shown;
static uint16_t turns;

static uint8_t work(uint8_t why) {
    (void)why;
    shown.pressed = (++turns / 50u) % 2u;
    bl_publish(BUMPER_CONTACT_OUT0);
    return 0;
}

const uint32_t bl_device_type BL_ROM = BUMPER_TYPE;
const bl_object bl_objects[BL_OBJECTS] BL_ROM = {{.hook = {[BL_ON_EXECUTE] = work}}};
const bl_port bl_ports[BL_PORTS] BL_ROM = {BUMPER_CONTACT_OUT0(&shown)};

uint8_t bl_call(uint8_t port, uint8_t *data) { (void)port, (void)data; return 1; }
uint8_t bl_text(uint8_t object, uint8_t code, uint8_t *text, uint8_t room) {
    (void)object, (void)code, (void)text, (void)room;
    return 0;
}

int main(int count, char **arguments) { board_run(count, arguments); }
