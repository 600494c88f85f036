/* Pins by the numbers of the robot's driver. */
#include <errno.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <stdio.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

struct request { unsigned int pin; char label[32]; };
struct value { unsigned int pin; int value; };

int main(void) {
    int pins = open("/dev/user-gpio", O_RDWR), bus = open("/dev/i2c-2", O_RDWR);
    struct request claim = {90, "reset"};
    struct value low = {90, 0}, high = {90, 1}, charger = {65, 9};
    unsigned char content = 0, first = 0x0B;
    struct timespec start, end;
    if (ioctl(pins, _IOW('G', 0x80, struct request), &claim) || ioctl(pins, _IO('G', 0x82), 65) ||
        ioctl(pins, _IOW('G', 0x83, struct value), &high) || ioctl(pins, _IOWR('G', 0x84, struct value), &charger))
        return 1;
    printf("charger %d\n", charger.value);
    ioctl(bus, I2C_SLAVE, 0x30);
    ioctl(pins, _IOW('G', 0x85, struct value), &low);
    printf("held %s\n", write(bus, &first, 1) < 0 && errno == ENXIO ? "ENXIO" : "?");
    usleep(1000);
    ioctl(pins, _IOW('G', 0x85, struct value), &high);
    if (write(bus, &first, 1) != 1 || read(bus, &content, 1) != 1)
        return 2;
    printf("kp %d\n", content);
    clock_gettime(CLOCK_MONOTONIC, &start);
    for (int i = 0; i < 100; i++) /* as a loop that waits for a level */
        ioctl(pins, _IOWR('G', 0x84, struct value), &charger);
    clock_gettime(CLOCK_MONOTONIC, &end);
    printf("100 levels %ld us\n", (end.tv_nsec - start.tv_nsec) / 1000);
    return 0;
}
