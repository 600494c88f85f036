#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/ioctl.h>

static int bus;

static void transfer(unsigned char *request, int n_request, unsigned char *reply, int n_reply) {
    struct i2c_msg messages[] = {{0x30, 0, n_request, request}, {0x30, I2C_M_RD, n_reply, reply}};
    struct i2c_rdwr_ioctl_data data = {messages, n_reply ? 2 : 1};
    if (bus < 0 || ioctl(bus, I2C_RDWR, &data) < 0)
        perror("/dev/i2c-2"), exit(1);
}

static void read_registers(int *values) {
    unsigned char bytes[256], *row, *byte; /* a row is a first register and a number of values */
    for (row = READS; row < READS + sizeof READS; row += 2) {
        transfer(row, 1, bytes, 2 * row[1]);
        for (byte = bytes; byte < bytes + 2 * row[1]; byte += 2)
            *values++ = (short)(byte[0] | byte[1] << 8);
    }
}

static void drive(int left, int right) {
    transfer((unsigned char[]){0x18, left & 255, left >> 8 & 255, right & 255, right >> 8 & 255}, 5, NULL, 0);
}

static void start(void) { /* gains as after a reset, all ultrasonic sensors, speed control */
    bus = open("/dev/i2c-2", O_RDWR);
    transfer((unsigned char[]){0x0B, 10, 5, 1}, 4, NULL, 0);
    transfer((unsigned char[]){0x7A, 31}, 2, NULL, 0);
    drive(0, 0);
    transfer((unsigned char[]){0x17, 1}, 2, NULL, 0);
}
