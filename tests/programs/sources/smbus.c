/* SMBus transfers, and arguments that the kernel refuses. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static void *BAD = (void *)8;

static int bus;

static void check(const char *name, long result) {
    const char *error = errno == EFAULT ? "EFAULT" : errno == EINVAL ? "EINVAL" : errno == EPROTO ? "EPROTO" : "?";
    printf("%s %s\n", name, result < 0 ? error : "0");
}

static int smbus(int is_read, int command, int size, union i2c_smbus_data *data) {
    struct i2c_smbus_ioctl_data call = {is_read, command, size, data};
    return ioctl(bus, I2C_SMBUS, &call);
}

static void print(const char *name, int result, const unsigned char *content, int count) {
    printf("%s %d:", name, result);
    for (int i = 0; i < count; i++)
        printf(" %d", content[i]);
    puts("");
}

int main(void) {
    union i2c_smbus_data data = {.block = {2, 11, 12}};
    struct i2c_msg message = {0x30, 0, 1, BAD}, read_message = {0x30, I2C_M_RD, 1, BAD};
    struct i2c_rdwr_ioctl_data none = {&message, 0}, bad = {&message, 1}, bad_read = {&read_message, 1},
                               unreadable = {BAD, 1};
    unsigned long functions;
    bus = open("/dev/i2c-2", O_RDWR);
    ioctl(bus, I2C_SLAVE, 0x30);
    print("write block", smbus(0, 0x00, I2C_SMBUS_I2C_BLOCK_DATA, &data), data.block, 0);
    data.block[0] = 4;
    int result = smbus(1, 0x00, I2C_SMBUS_I2C_BLOCK_DATA, &data);
    print("read block", result, data.block, 5);
    result = smbus(1, 0x00, I2C_SMBUS_I2C_BLOCK_BROKEN, &data);
    print("broken block", result, data.block, 5);
    data.word = 0x0102;
    result = smbus(0, 0x00, I2C_SMBUS_PROC_CALL, &data);
    print("process call", result, data.block, 2);
    check("smbus block write", smbus(0, 0x30, I2C_SMBUS_BLOCK_DATA, &(union i2c_smbus_data){.block = {1, 9}}));
    data.block[0] = 5;
    result = smbus(1, 0x02, I2C_SMBUS_BLOCK_DATA, &data);
    print("smbus block", result, data.block, 3);
    check("long block", smbus(0, 0, I2C_SMBUS_I2C_BLOCK_DATA, &(union i2c_smbus_data){.block = {33}}));
    check("quick", smbus(0, 0, I2C_SMBUS_QUICK, NULL));
    check("size", smbus(0, 0, 9, &data));
    check("no data", smbus(1, 0, I2C_SMBUS_BYTE_DATA, NULL));
    check("bad data", smbus(1, 0, I2C_SMBUS_BYTE_DATA, BAD));
    check("functions", ioctl(bus, I2C_FUNCS, &functions));
    printf("quick %d, blocks %d, slave data %d\n", !!(functions & I2C_FUNC_SMBUS_QUICK),
           (functions & I2C_FUNC_SMBUS_I2C_BLOCK) == I2C_FUNC_SMBUS_I2C_BLOCK,
           !!(functions & I2C_FUNC_SMBUS_READ_BLOCK_DATA));
    check("no messages", ioctl(bus, I2C_RDWR, &none));
    check("bad message", ioctl(bus, I2C_RDWR, &bad));
    check("bad target", ioctl(bus, I2C_RDWR, &bad_read));
    check("bad messages", ioctl(bus, I2C_RDWR, &unreadable));
    check("bad argument", ioctl(bus, I2C_RDWR, BAD));
    check("bad smbus", ioctl(bus, I2C_SMBUS, BAD));
    check("bad functions", ioctl(bus, I2C_FUNCS, BAD));
    check("bad write", write(bus, BAD, 1));
    check("bad read", read(bus, BAD, 1));
    check("empty", write(bus, "", 0));
    check("slave", ioctl(bus, I2C_SLAVE, 0x80));
    check("bad path", open(BAD, O_RDWR));
    check("bad pin", ioctl(open("/dev/user-gpio", O_RDWR), _IOWR('G', 0x84, long), BAD));
    check("bad sleep", nanosleep(BAD, NULL));
    check("bad select", select(1, BAD, NULL, NULL, NULL));
    check("bad limit", select(0, NULL, NULL, NULL, BAD));
    check("bad poll", ppoll(NULL, 0, BAD, NULL));
    check("bad futex", syscall(SYS_futex, BAD, 0, 1, NULL, NULL, 0));
    return 0;
}
