/* A program that asks for ever. */
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <sys/ioctl.h>
#include <unistd.h>

int main(void) {
    int bus = open("/dev/i2c-2", O_RDWR);
    ioctl(bus, I2C_SLAVE, 0x30);
    for (;;) {
        if (write(bus, "\0", 1) != 1)
            return 2;
        usleep(1000);
    }
}
