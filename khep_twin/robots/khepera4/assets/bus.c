/* Microcontroller at 0x30 of the I2C bus 2, as K-Team's library uses it. */
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <stdlib.h>
#include <sys/ioctl.h>

static int bus;

static void transfer(const unsigned char *request, int n_request, unsigned char *reply, int n_reply) {
    struct i2c_msg request_and_reply[] = {
        {0x30, 0, n_request, (unsigned char *)request}, {0x30, I2C_M_RD, n_reply, reply}};
    struct i2c_rdwr_ioctl_data messages = {request_and_reply, n_reply ? 2 : 1};
    if (ioctl(bus, I2C_RDWR, &messages) < 0)
        perror("/dev/i2c-2"), exit(1);
}

static void read_registers(int *values) {
    unsigned char bytes[256];
    int number, i;
    for (number = 0; number < N_READS; number++) {
        transfer(READS[number], 1, bytes, 2 * READS[number][1]);
        for (i = 0; i < READS[number][1]; i++)
            *values++ = (short)(bytes[2 * i] | bytes[2 * i + 1] << 8);
    }
}

static void drive(int left, int right) {
    const unsigned char speeds[] = {0x18, left & 255, left >> 8 & 255, right & 255, right >> 8 & 255};
    transfer(speeds, 5, NULL, 0);
}

static void start(void) { /* gains as after a reset, all ultrasonic sensors, speed control */
    bus = open("/dev/i2c-2", O_RDWR);
    transfer((const unsigned char[]){0x0B, 10, 5, 1}, 4, NULL, 0);
    transfer((const unsigned char[]){0x7A, 31}, 2, NULL, 0);
    drive(0, 0);
    transfer((const unsigned char[]){0x17, 1}, 2, NULL, 0);
}
