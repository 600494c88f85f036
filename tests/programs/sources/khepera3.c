/* A Khepera III as its library (/dev/i2c-0) and its toolbox (/dev/i2c/0) find it; it drives on after the end. */
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <linux/i2c.h>
#include <stdio.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <unistd.h>

static int library, toolbox;

static int transfer(int address, const void *request, int n_request, void *reply, int n_reply) {
    struct i2c_msg messages[] = {{address, 0, n_request, (void *)request}, {address, I2C_M_RD, n_reply, reply}};
    struct i2c_rdwr_ioctl_data data = {messages, n_reply ? 2 : 1};
    return ioctl(toolbox, I2C_RDWR, &data);
}

static void set(int address, int reg, int size, int value) {
    while (size--) {
        unsigned char message[] = {reg + size, value >> 8 * size};
        transfer(address, message, 2, NULL, 0);
    }
}

static int get(int address, int reg) {
    int value = 0;
    for (int byte = 3; byte >= 0; byte--) {
        unsigned char place = reg + byte, content;
        transfer(address, &place, 1, &content, 1);
        value = value << 8 | content;
    }
    return value;
}

int main(void) {
    unsigned char frame[30] = {0};
    char line[80] = "";
    FILE *file = fopen("/etc/libkorebot/khepera3.knc", "r");
    int memory = open("/dev/mem", O_RDWR | O_SYNC);
    library = open("/dev/i2c-0", O_RDWR), toolbox = open("/dev/i2c/0", O_RDWR);
    volatile unsigned *pins = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, memory, 0x40E00000);
    printf("%s", fgets(line, sizeof line, file));
    printf("pin 40 %d, word 0x10 %x\n", pins[1] >> 8 & 1, pins[4]);
    for (int address = 0x29; address < 0x32; address += 4) /* by empty messages */
        printf("%x %d\n", address, transfer(address, NULL, 0, NULL, 0));
    ioctl(library, I2C_SLAVE, 0x31);
    write(library, "\2B", 2);
    read(library, frame, 1);
    printf("%d bytes", frame[0]);
    read(library, frame, frame[0]);
    printf(": %c %d.%d\n", frame[0], frame[1], frame[3]);
    transfer(0x31, "\2N", 2, frame, 29);
    printf("%d bytes: %c, ground %d\n", frame[0], frame[2], (frame[21] | frame[22] << 8) > 3900);
    for (int side = 0; side < 2; side++) {
        set(0x29 + side, 0x28, 1, 1);
        set(0x29 + side, 0x2C, 1, 3);
        set(0x29 + side, 0x2F, 4, side ? 10000 : -10000);
    }
    sleep(1);
    printf("%d %d\n", get(0x29, 0x34) / 100, get(0x2A, 0x34) / 100);
    return 0;
}
