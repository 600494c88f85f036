/* File descriptors of the bus that the C library or the kernel closes or copies. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <linux/i2c-dev.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <sys/uio.h>
#include <sys/wait.h>
#include <unistd.h>

static const unsigned char first = 0;

static int open_bus(void) {
    int bus = open("/dev/i2c-2", O_RDWR);
    ioctl(bus, I2C_SLAVE, 0x30);
    return bus;
}

/* Write speeds to a file whose number was the bus's; print how many bytes it has. */
static void check_file(const char *name, int expected_fd) {
    unsigned char speed[] = {0x18, 250, 0, 250, 0};
    int fd = open("data.bin", O_RDWR | O_CREAT | O_TRUNC, 0600);
    ssize_t n = write(fd, speed, sizeof speed);
    printf("%s %s %zd %ld\n", name, fd == expected_fd ? "reused" : "other", n, (long)lseek(fd, 0, SEEK_END));
    close(fd);
}

static FILE *open_stream(void) {
    FILE *stream = fopen("/dev/i2c-2", "r+");
    ioctl(fileno(stream), I2C_SLAVE, 0x30);
    return stream;
}

int main(int count, char **words) {
    unsigned char content[2] = {0, 0};
    struct iovec buffers[2] = {{(void *)&first, 1}, {(void *)&first, 1}}, input[2] = {{content, 1}, {content + 1, 1}};
    if (count > 1) /* in a new program, with the bus of the old one */
        return read(words[1][0] - '0', content, 1) == 1 && content[0] ? 9 : 1;

    FILE *stream = open_stream();
    int fd = fileno(stream);
    fclose(stream);
    check_file("fclose", fd);
    stream = open_stream();
    fd = fileno(stream);
    stream = freopen("text.txt", "w", stream);
    fputs("text\n", stream);
    fclose(stream);
    check_file("freopen", fd);
    stream = freopen("/dev/i2c-2", "w", fopen("text.txt", "r"));
    int result = ioctl(fileno(stream), I2C_SLAVE, 0x30);
    printf("to the bus %d %zd\n", result, write(fileno(stream), &first, 1));
    setvbuf(stream, NULL, _IONBF, 0);
    printf("stream %d\n", fputc(0, stream));
    fclose(stream);
    fd = open_bus();
    syscall(SYS_close, fd);
    check_file("call", fd);
    fd = open_bus();
    closefrom(fd);
    check_file("closefrom", fd);
    fd = open_bus();
    syscall(SYS_close_range, fd, ~0u, 0);
    check_file("range", fd);
    fd = open_bus();
    int text = open("data.bin", O_RDWR);
    dup2(text, fd);
    close(text);
    result = ioctl(fd, I2C_SLAVE, 0x30);
    printf("dup2 %d %zd\n", result, write(fd, &first, 1));
    close(fd);

    fd = open_bus();
    int copy = fcntl(fd, F_DUPFD, 20);
    result = ioctl(copy, I2C_SLAVE, 0x30);
    printf("F_DUPFD %d %zd\n", result, write(copy, &first, 1));
    ioctl(copy, I2C_SLAVE, 0x20); /* which all copies share */
    printf("shared %zd\n", write(fd, &first, 1));
    ioctl(fd, I2C_SLAVE, 0x30);
    printf("vectors %zd %zd\n", writev(fd, buffers, 2), readv(fd, input, 2));
    printf("offsets %zd %zd\n", pwrite(fd, &first, 1, 7), pread(fd, content, 2, 9));
    printf("calls %ld %ld\n", syscall(SYS_write, fd, &first, 1), syscall(SYS_read, fd, content, 1));
    fflush(stdout);
    int status = 0, low = dup2(fd, 8);
    if (!fork())
        execl(words[0], words[0], "8", NULL);
    wait(&status);
    printf("inherited %d %d\n", low, WEXITSTATUS(status));

    /* A timer whose file descriptor is closed does not write into the next file. */
    int timer = timerfd_create(CLOCK_MONOTONIC, 0);
    timerfd_settime(timer, 0, &(struct itimerspec){{0, 1000000}, {0, 1000000}}, NULL);
    closefrom(timer);
    check_file("timer", timer);
    text = open("data.bin", O_RDWR);
    usleep(10000);
    printf("after %ld\n", (long)lseek(text, 0, SEEK_END));
    return 0;
}
