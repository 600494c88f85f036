/* The bus as the robot's library uses it: a probe, transfers, and plain writes. */
#include <errno.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <stdio.h>
#include <sys/ioctl.h>
#include <unistd.h>

static int bus;

static int get(unsigned char address, unsigned char first, unsigned char *content, int count) {
    struct i2c_msg messages[2] = {{address, 0, 1, &first}, {address, I2C_M_RD, count, content}};
    struct i2c_rdwr_ioctl_data both = {messages, 2};
    return ioctl(bus, I2C_RDWR, &both);
}

int main(void) {
    unsigned char content[4];
    union i2c_smbus_data data;
    struct i2c_smbus_ioctl_data probe = {I2C_SMBUS_READ, 0, I2C_SMBUS_BYTE, &data};
    bus = open("/dev/i2c-2", O_RDWR);
    printf("slave %d\n", ioctl(bus, I2C_SLAVE, 0x30));
    printf("probe %d\n", ioctl(bus, I2C_SMBUS, &probe) >= 0);
    printf("other %s\n", get(0x20, 0, content, 1) < 0 && errno == ENXIO ? "ENXIO" : "?");
    get(0x30, 0, content, 1);
    printf("revision %c %d\n", (content[0] >> 4) + 'A', content[0] & 15);
    if (write(bus, (unsigned char[]){0x17, 1}, 2) != 2 || write(bus, (unsigned char[]){0x18, 244, 1, 244, 1}, 5) != 5)
        return 1;
    for (int i = 0; i < 25; i++) {
        get(0x30, 0x28, content, 4);
        printf("%d\n", (short)(content[0] | content[1] << 8));
        usleep(100000);
    }
    return 3;
}
