/* Nodes and files of the robot, by path. */
#include <dirent.h>
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <stdio.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <unistd.h>

int main(void) {
    struct stat found, same;
    unsigned char first = 0;
    int number = 0, entries = 0;
    printf("bus %d %d\n", access("/dev/i2c-2", R_OK | W_OK),
           stat("/dev/i2c-2", &found) || !S_ISCHR(found.st_mode));
    printf("pins %d %d\n", access("/dev/user-gpio", F_OK),
           lstat("/dev/pwm8", &same) || !S_ISCHR(same.st_mode));
    printf("camera %d\n", open("/dev/video6", O_RDWR));
    FILE *bus = fopen("/dev/i2c-2", "r+");
    printf("stream %d\n", ioctl(fileno(bus), I2C_SLAVE, 0x30));
    printf("write %zd\n", write(fileno(bus), &first, 1));
    fclose(bus);
    FILE *file = fopen("/etc/khepera/robotid", "r");
    if (!file || fscanf(file, "%d", &number) != 1)
        return 1;
    printf("robot %d\n", number);
    DIR *folder = opendir("/etc/libkhepera");
    while (folder && readdir(folder))
        entries++;
    printf("entries %d\n", entries);
    printf("none %d\n", open("/etc/khepera/none", O_RDONLY));
    return 0;
}
