/* Reads all sensors of a Khepera IV at 20 Hz and steers by them, for a time in seconds. */

#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/ioctl.h>
#include <unistd.h>

static int bus;

static void get(uint8_t first, uint8_t *content, int count) {
    struct i2c_msg messages[] = {{0x30, 0, 1, &first}, {0x30, I2C_M_RD, count, content}};
    struct i2c_rdwr_ioctl_data both = {messages, 2};
    if (ioctl(bus, I2C_RDWR, &both) < 0)
        exit(1);
}

static void put(uint8_t *content, int count) {
    struct i2c_msg message = {0x30, 0, count, content};
    struct i2c_rdwr_ioctl_data one = {&message, 1};
    if (ioctl(bus, I2C_RDWR, &one) < 0)
        exit(1);
}

int main(int count, char **words) {
    uint8_t light[24], near[24], echoes[10], felt[60], turned[60], places[8], battery[12];
    bus = open("/dev/i2c-2", O_RDWR);
    put((uint8_t[]){0x17, 1}, 2);
    for (int left = 20 * atoi(words[count - 1]); left > 0; left--) {
        get(0x40, light, sizeof light);
        get(0x58, near, sizeof near);
        get(0x70, echoes, sizeof echoes);
        get(0x80, felt, sizeof felt);
        get(0xC0, turned, sizeof turned);
        get(0x2D, places, sizeof places);
        get(0xFD, battery, sizeof battery);
        int ahead = near[6] | near[7] << 8, turn = ahead > 150 ? 300 : 0;
        int speeds[] = {300 - turn, 300 + turn};
        put((uint8_t[]){0x18, speeds[0], speeds[0] >> 8, speeds[1], speeds[1] >> 8}, 5);
        usleep(50000);
    }
    return 0;
}
