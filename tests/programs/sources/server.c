/* A server of a network: it drives, and answers each datagram with its time and the pulses of its left wheel. */
#include <arpa/inet.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

int main(int count, char **words) {
    int bus = open("/dev/i2c-2", O_RDWR), line = socket(AF_INET, SOCK_DGRAM, 0);
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_addr = {htonl(INADDR_LOOPBACK)}}, peer;
    socklen_t size = sizeof here;
    bind(line, (struct sockaddr *)&here, sizeof here);
    getsockname(line, (struct sockaddr *)&here, &size);
    printf("%d\n", ntohs(here.sin_port));
    fflush(stdout);
    if (count > 1 && !strcmp(words[1], "limit"))
        setsockopt(line, SOL_SOCKET, SO_RCVTIMEO, &(struct timeval){0, 30000}, sizeof(struct timeval));
    ioctl(bus, I2C_SLAVE, 0x30);
    if (write(bus, (unsigned char[]){0x17, 1}, 2) != 2 || write(bus, (unsigned char[]){0x18, 44, 1, 44, 1}, 5) != 5)
        return 1;
    for (;;) {
        char text[64] = "";
        unsigned char pulses[4];
        struct timespec time;
        size = sizeof peer;
        if (count > 1 && !strcmp(words[1], "poll") && !poll(&(struct pollfd){line, POLLIN, 0}, 1, 30))
            continue;
        if (recvfrom(line, text, sizeof text - 1, 0, (struct sockaddr *)&peer, &size) < 0)
            continue;
        if (write(bus, (unsigned char[]){0x2D}, 1) != 1 || read(bus, pulses, 4) != 4 || text[0] == 'q')
            return 0;
        clock_gettime(CLOCK_MONOTONIC, &time);
        snprintf(text, sizeof text, "%.3f %d", time.tv_sec + time.tv_nsec * 1e-9, pulses[0] | pulses[1] << 8 | pulses[2] << 16);
        sendto(line, text, strlen(text), 0, (struct sockaddr *)&peer, size);
    }
}
