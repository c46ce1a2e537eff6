/* A device as a process on a pty, or with -DBL_DATAGRAM on a UDP port of this computer. It adds
 * numbers, and publishes each value that it is given with one more in trace[0].
 *
 *     firmware PORT BOOTS     BOOTS is a file: the EEPROM in which it counts its starts */
#define _DEFAULT_SOURCE
#include "blastema_lite.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static devices_value in, taken, out;
static devices_limit limit;
static uint32_t total, calls;
static uint16_t boot;
static int line = -1;
static char **arguments;
#ifdef BL_DATAGRAM
static struct sockaddr_in host;
#endif

static uint8_t work(uint8_t why) {
    (void)why;
    if (in.number == 666) return 7;
    if (memcmp(&in, &taken, sizeof in) != 0) {
        taken = in;
        out = in;
        out.trace[0]++;
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

void bl_restart(void) {
    if (line >= 0) close(line);
    execv(arguments[0], arguments);
    abort();
}
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
uint16_t bl_millis(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint16_t)((uint64_t)now.tv_sec * 1000u + (uint64_t)now.tv_nsec / 1000000u);
}
void bl_send(const uint8_t *bytes, uint8_t n) {
#ifdef BL_DATAGRAM
    (void)sendto(line, bytes, n, 0, (struct sockaddr *)&host, sizeof host);
#else
    uint8_t sent = 0;
    while (sent < n) {
        ssize_t written = write(line, bytes + sent, (size_t)(n - sent));
        if (written <= 0) return;
        sent = (uint8_t)(sent + written);
    }
#endif
}

static void open_line(void) {
#ifdef BL_DATAGRAM
    struct sockaddr_in own = {.sin_family = AF_INET};
    own.sin_port = htons((uint16_t)atoi(arguments[1]));
    own.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    line = socket(AF_INET, SOCK_DGRAM, 0);
    if (line < 0 || bind(line, (struct sockaddr *)&own, sizeof own) != 0) exit(1);
#else
    struct termios settings;
    line = open(arguments[1], O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (line < 0) {
        usleep(10000);
    } else if (tcgetattr(line, &settings) == 0) {
        cfmakeraw(&settings);
        cfsetspeed(&settings, B115200);
        tcsetattr(line, TCSANOW, &settings);
    }
#endif
}

static void receive(void) {
    uint8_t bytes[256];
    struct pollfd readable = {.fd = line, .events = POLLIN};
    if (poll(&readable, 1, 1) <= 0) return;
#ifdef BL_DATAGRAM
    socklen_t size = sizeof host;
    ssize_t n = recvfrom(line, bytes, sizeof bytes, 0, (struct sockaddr *)&host, &size);
    if (n > 0 && n < 256) bl_receive_packet(bytes, (uint8_t)n);
#else
    ssize_t n = read(line, bytes, sizeof bytes);
    if (n == 0 || (n < 0 && errno != EAGAIN)) {
        close(line);
        line = -1;
    }
    for (ssize_t i = 0; i < n; i++) bl_receive(bytes[i]);
#endif
}

int main(int count, char **given) {
    unsigned boots = 0;
    FILE *file;
    arguments = given;
    if (count != 3) return 1;
    if ((file = fopen(given[2], "r")) != NULL) {
        if (fscanf(file, "%u", &boots) != 1) boots = 0;
        fclose(file);
    }
    boot = (uint16_t)(boots + 1u);
    if ((file = fopen(given[2], "w")) == NULL) return 1;
    fprintf(file, "%u", (unsigned)boot);
    fclose(file);
    bl_begin(boot, BL_CAUSE_POWER_ON);
    for (;;) {
        if (line < 0) open_line();
        if (line >= 0) receive();
        bl_poll();
    }
}
