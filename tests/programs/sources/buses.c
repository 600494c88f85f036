/* Two buses, probes by empty messages, memory and files of a robot's computer. */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <stdio.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

static const char *name_of(long result) {
    return result >= 0 ? "" : errno == ENXIO ? " ENXIO" : errno == EINVAL ? " EINVAL" : " ?";
}

static void print(const char *name, long result) { printf("%s %ld%s\n", name, result, name_of(result)); }

static int transfer(int bus, int address, int is_read, unsigned char *content, int count) {
    struct i2c_msg message = {address, is_read ? I2C_M_RD : 0, count, content};
    struct i2c_rdwr_ioctl_data data = {&message, 1};
    return ioctl(bus, I2C_RDWR, &data);
}

static int quick(int bus, int is_read) {
    struct i2c_smbus_ioctl_data call = {is_read, 0, I2C_SMBUS_QUICK, NULL};
    return ioctl(bus, I2C_SMBUS, &call);
}

static volatile unsigned *map(int file, long address) {
    return mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, file, address);
}

int main(int count, char **words) {
    int number = 0, entries = 0, memory = open("/dev/mem", O_RDWR | O_SYNC);
    FILE *file = fopen("/etc/robot/number", "r");
    if (!file || fscanf(file, "%d", &number) != 1)
        return 90;
    volatile unsigned *pins = map(memory, 0x40E00000);
    if (count > 1) { /* whether each robot has its own memory */
        pins[4] = number;
        usleep(2000);
        return map(memory, 0x40E00000)[4];
    }
    unsigned char content[3] = {7, 8, 9};
    unsigned long functions;
    int bus = open("/dev/i2c/0", O_RDWR), same = open("/dev/i2c-0", O_RDWR), other = open("/dev/i2c-12", O_RDWR);
    print("unknown", open("/dev/i2c/00", O_RDWR));
    print("probe", transfer(bus, 0x31, 0, NULL, 0));
    print("read probe", transfer(bus, 0x31, 1, NULL, 0));
    print("nobody", transfer(bus, 0x32, 0, NULL, 0));
    print("other bus", transfer(other, 0x31, 0, NULL, 0));
    print("slave", ioctl(bus, I2C_SLAVE, 0x31) | ioctl(other, I2C_SLAVE, 0x31));
    print("quick", quick(bus, 0) | quick(bus, 1) | write(bus, "", 0));
    print("other quick", quick(other, 0));
    ioctl(bus, I2C_FUNCS, &functions);
    print("functions", !!(functions & I2C_FUNC_SMBUS_QUICK));
    ioctl(other, I2C_FUNCS, &functions);
    print("other functions", !!(functions & I2C_FUNC_SMBUS_QUICK));
    print("write", write(bus, content, 3));
    print("other write", write(other, content + 1, 2));
    print("one shot", transfer(same, 0x29, 0, content + 2, 1) + transfer(bus, 0x29, 1, content, 1));
    printf("content %d\n", content[0]);
    print("read", read(bus, content, 1));
    printf("content %d\n", content[0]);
    print("other read", read(other, content, 1));
    printf("content %d\n", content[0]);
    int again = open("/dev/mem", O_RDWR);
    printf("pins %#x %#x\n", pins[1], pins[2]);
    pins[4] |= 1 << 8;
    printf("again %#x, clock %#x\n", map(again, 0x40E00000)[4], map(again, 0x41300000)[0]);
    DIR *folder = opendir("/etc/robot");
    while (folder && readdir(folder))
        entries++;
    printf("robot %d, entries %d, none %d\n", number, entries, access("/etc/robot/none", F_OK));
    file = fopen("/etc/robot/new", "w");
    struct stat status;
    int written = file && fputs("text", file) >= 0 && !fclose(file) && !stat("/etc/robot/new", &status);
    printf("new %d, bytes %d\n", written, (int)status.st_size);
    printf("beside %d\n", access("/etc/robot2", F_OK));
    return 0;
}
