#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/ioctl.h>

static int bus;

/* Send a request, unless it is empty, and receive a reply, unless it is empty. */
static void transfer(int address, unsigned char *request, int n_request, unsigned char *reply, int n_reply) {
    struct i2c_msg messages[] = {{address, 0, n_request, request}, {address, I2C_M_RD, n_reply, reply}};
    struct i2c_rdwr_ioctl_data data = {messages + !n_request, !!n_request + !!n_reply};
    if (bus < 0 || ioctl(bus, I2C_RDWR, &data) < 0)
        perror(BUS), exit(1);
}

