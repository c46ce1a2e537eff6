/* The board of a process of this computer: on a pty, or with -DBL_DATAGRAM on a UDP port of this computer.
 *
 *     firmware PORT BOOTS     BOOTS is a file: the EEPROM in which it counts its starts */
#define _DEFAULT_SOURCE
#include "board.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static int line = -1;
static char **given;
#ifdef BL_DATAGRAM
static struct sockaddr_in host;
#endif

void bl_restart(void) {
    if (line >= 0) close(line);
    execv(given[0], given);
    abort();
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
    own.sin_port = htons((uint16_t)atoi(given[1]));
    own.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    line = socket(AF_INET, SOCK_DGRAM, 0);
    if (line < 0 || bind(line, (struct sockaddr *)&own, sizeof own) != 0) exit(1);
#else
    struct termios settings;
    line = open(given[1], O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (line < 0) {
        usleep(10000);
    } else if (tcgetattr(line, &settings) == 0) {
        cfmakeraw(&settings);
        cfsetspeed(&settings, B115200);
        tcsetattr(line, TCSANOW, &settings);
    }
#endif
}

void board_receive(void) {
    uint8_t bytes[256];
    if (line < 0) open_line();
    if (line < 0) return;
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

uint16_t board_begin(int count, char **arguments, uint8_t *cause) {
    unsigned boots = 0;
    FILE *file;
    given = arguments;
    if (count != 3) exit(1);
    if ((file = fopen(given[2], "r")) != NULL) {
        if (fscanf(file, "%u", &boots) != 1) boots = 0;
        fclose(file);
    }
    boots++;
    if ((file = fopen(given[2], "w")) == NULL) exit(1);
    fprintf(file, "%u", boots);
    fclose(file);
    *cause = BL_CAUSE_POWER_ON;
    return (uint16_t)boots;
}
