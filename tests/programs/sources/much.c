/* More handles, bytes and requests than a program should have. */
#include <errno.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <stdio.h>
#include <sys/ioctl.h>
#include <unistd.h>

static unsigned char content[65536];

int main(void) {
    int handle = -1, opened = 0;
    while (opened < 1000 && (handle = open("/dev/i2c-2", O_RDWR)) >= 0)
        opened++;
    printf("opened %d\n", opened);
    ioctl(handle, I2C_SLAVE, 0x30);
    printf("long %zd\n", write(handle, content, sizeof content));
    printf("bad %s\n", ioctl(handle, 0x1234, content) < 0 && errno == ENOTTY ? "ENOTTY" : "?");
    printf("copy %zd\n", write(dup(handle), content, 1));
    fflush(stdout);
    for (int i = 3; i < 5000; i++)
        close(i);
    usleep(1000);
    puts("closed");
    return 0;
}
