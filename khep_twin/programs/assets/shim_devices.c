/* Device nodes of the robot, by file descriptor: its I2C buses and its pins.

   A node is an empty file in memory that cannot be written. Its time of modification holds the number of the
   node, with the address of the I2C slave, so the kernel keeps it, for all copies of the file descriptor in
   all processes, and only as long as one is open. */

#include "shim.h"

#include <fcntl.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>

#include <linux/i2c-dev.h>
#include <linux/i2c.h>

#define NODE_SECOND (-1263680598) /* in 1929; no other file is as old */
#define MAX_BYTES 131072
#define MAX_MESSAGE 8192

int node_of_fd(int fd) {
    struct statx status;
    int saved_errno = errno;
    if (fd < 0 || REAL(statx)(fd, "", AT_EMPTY_PATH, STATX_MTIME, &status))
        return errno = saved_errno, 0;
    return status.stx_mtime.tv_sec == NODE_SECOND ? status.stx_mtime.tv_nsec : 0;
}

void mark_node(int fd, int node) {
    futimens(fd, (struct timespec[]){{0, UTIME_OMIT}, {NODE_SECOND, node}});
}

int open_node(int node, int flags) {
    int fd = memfd_create("khep-twin", MFD_ALLOW_SEALING | (flags & O_CLOEXEC ? MFD_CLOEXEC : 0));
    if (fd < 0)
        return -1;
    fcntl(fd, F_ADD_SEALS, F_SEAL_WRITE | F_SEAL_GROW | F_SEAL_SHRINK);
    mark_node(fd, node);
    return fd;
}

/* I2C ---------------------------------------------------------------------------------------------------- */
/* The answers are those of the robots' kernels and adapters (i2c-dev, i2c-omap). */

/* Run messages; their contents are in the memory of the program. Return their number or minus an error. */
static int transfer(int node, struct i2c_msg *messages, uint32_t count) {
    unsigned char small_buffer[512] = {0}, *out = small_buffer;
    size_t length = 0, n_read = 0;
    for (uint32_t i = 0; i < count; i++) {
        if ((!messages[i].len && !SENDS_EMPTY(node)) || messages[i].len > MAX_MESSAGE)
            return -EINVAL;
        length += 3 * sizeof(uint16_t) + (messages[i].flags & I2C_M_RD ? 0 : messages[i].len);
        n_read += messages[i].flags & I2C_M_RD ? messages[i].len : 0;
    }
    if (length + n_read > MAX_BYTES)
        return -ENOMEM;
    if (length + n_read > sizeof small_buffer && !(out = malloc(length + n_read)))
        return -ENOMEM;
    unsigned char *position = out, *reply = out + length;
    int result = 0;
    for (uint32_t i = 0; i < count && !result; i++) {
        struct i2c_msg *message = &messages[i];
        int is_read = message->flags & I2C_M_RD;
        uint16_t words[3] = {message->addr, message->flags, message->len};
        memcpy(position, words, sizeof words);
        position += sizeof words;
        if (copy_memory(is_read ? reply : position, message->buf, message->len))
            result = -EFAULT;
        position += is_read ? 0 : message->len;
    }
    if (!result)
        result = exchange(TRANSFER, BUS(node) << 16 | count, out, length, reply, n_read, NULL);
    for (uint32_t i = 0; result >= 0 && i < count; i++)
        if (messages[i].flags & I2C_M_RD) {
            if (copy_memory(messages[i].buf, reply, messages[i].len))
                result = -EFAULT;
            reply += messages[i].len;
        }
    if (out != small_buffer)
        free(out);
    return result;
}

static ssize_t transfer_one(int node, int is_read, void *content, size_t count) {
    size_t length = count > MAX_MESSAGE ? MAX_MESSAGE : count;
    struct i2c_msg message = {SLAVE(node), is_read ? I2C_M_RD : 0, length, content};
    int result = transfer(node, &message, 1);
    return c_result(result < 0 ? result : message.len);
}

/* I2C_RDWR. The adapter ignores I2C_M_RECV_LEN, so a message with it reads its first byte's number. */
static int transfer_all(int node, void *argument) {
    struct i2c_rdwr_ioctl_data data;
    struct i2c_msg messages[I2C_RDWR_IOCTL_MAX_MSGS];
    unsigned char count;
    if (copy_memory(&data, argument, sizeof data))
        return -EFAULT;
    if (!data.msgs || !data.nmsgs || data.nmsgs > I2C_RDWR_IOCTL_MAX_MSGS)
        return -EINVAL;
    if (copy_memory(messages, data.msgs, data.nmsgs * sizeof *messages))
        return -EFAULT;
    for (uint32_t i = 0; i < data.nmsgs; i++)
        if (messages[i].flags & I2C_M_RECV_LEN && messages[i].len) {
            if (copy_memory(&count, messages[i].buf, 1))
                return -EFAULT;
            if (!(messages[i].flags & I2C_M_RD) || !count || messages[i].len < count + I2C_SMBUS_BLOCK_MAX)
                return -EINVAL;
            messages[i].len = count;
        }
    return transfer(node, messages, data.nmsgs);
}

/* I2C_SMBUS, emulated by I2C messages: a command and bytes out, then bytes in. */
static int transfer_smbus(int node, void *argument) {
    struct i2c_smbus_ioctl_data smbus;
    union i2c_smbus_data data = {.block = {0}};
    unsigned char out[I2C_SMBUS_BLOCK_MAX + 2], in[I2C_SMBUS_BLOCK_MAX + 2] = {0};
    if (copy_memory(&smbus, argument, sizeof smbus))
        return -EFAULT;
    int is_read = smbus.read_write == I2C_SMBUS_READ, is_broken = smbus.size == I2C_SMBUS_I2C_BLOCK_BROKEN;
    int size = is_broken ? I2C_SMBUS_I2C_BLOCK_DATA : (int)smbus.size, n_out = 0, n_in = 0;
    if (smbus.size > I2C_SMBUS_I2C_BLOCK_DATA || smbus.read_write > I2C_SMBUS_READ)
        return -EINVAL;
    if (size == I2C_SMBUS_QUICK) {
        int result = transfer(node, &(struct i2c_msg){SLAVE(node), is_read ? I2C_M_RD : 0, 0, NULL}, 1);
        return result < 0 ? result : 0;
    }
    int is_call = size == I2C_SMBUS_PROC_CALL || size == I2C_SMBUS_BLOCK_PROC_CALL;
    int has_data = is_read || size != I2C_SMBUS_BYTE, data_size = sizeof data.block;
    if (size == I2C_SMBUS_BYTE || size == I2C_SMBUS_BYTE_DATA)
        data_size = 1;
    else if (size == I2C_SMBUS_WORD_DATA || size == I2C_SMBUS_PROC_CALL)
        data_size = 2;
    if (has_data && !smbus.data)
        return -EINVAL;
    if (has_data && (is_call || size == I2C_SMBUS_I2C_BLOCK_DATA || !is_read) &&
        copy_memory(&data, smbus.data, data_size))
        return -EFAULT;
    if (is_broken && is_read)
        data.block[0] = I2C_SMBUS_BLOCK_MAX;
    int is_block = data_size == sizeof data.block, reads_block = is_read && size == I2C_SMBUS_BLOCK_DATA;
    if (is_block && !reads_block && data.block[0] > I2C_SMBUS_BLOCK_MAX)
        return -EINVAL;
    is_read |= is_call;
    int skips_count = size == I2C_SMBUS_I2C_BLOCK_DATA; /* the number of bytes is not sent */
    if (size != I2C_SMBUS_BYTE || !is_read)
        out[n_out++] = smbus.command;
    if (size != I2C_SMBUS_BYTE && (!is_read || is_call)) {
        int n = is_block ? data.block[0] + !skips_count : data_size;
        memcpy(out + n_out, data.block + skips_count, n);
        n_out += n;
    }
    if (is_read) /* the adapter reads only the first byte of an SMBus block, its length */
        n_in = skips_count ? data.block[0] : is_block ? 1 : data_size;
    struct i2c_msg messages[2] = {{SLAVE(node), 0, n_out, out}, {SLAVE(node), I2C_M_RD, n_in, in}};
    int result = n_out ? transfer(node, messages, 1 + is_read) : transfer(node, messages + 1, 1);
    if (result < 0)
        return result;
    if (is_block && !skips_count && in[0] > I2C_SMBUS_BLOCK_MAX)
        return -EPROTO;
    memcpy(data.block + skips_count, in, skips_count ? n_in : data_size);
    return is_read && copy_memory(smbus.data, &data, data_size) ? -EFAULT : 0;
}

static int control_i2c(int fd, int node, unsigned long request, void *argument) {
    unsigned long missing = SENDS_EMPTY(node) ? 0 : I2C_FUNC_SMBUS_QUICK;
    unsigned long functions = I2C_FUNC_I2C | (I2C_FUNC_SMBUS_EMUL & ~missing);
    switch (request) {
    case I2C_SLAVE:
    case I2C_SLAVE_FORCE:
        if ((uintptr_t)argument > 0x7F)
            return -EINVAL;
        mark_node(fd, (node & ~0x7F) | (uintptr_t)argument);
        return 0;
    case I2C_FUNCS:
        return copy_memory(argument, &functions, sizeof functions) ? -EFAULT : 0;
    case I2C_RDWR:
        return transfer_all(node, argument);
    case I2C_SMBUS:
        return transfer_smbus(node, argument);
    case I2C_TIMEOUT:
    case I2C_RETRIES:
    case I2C_TENBIT:
    case I2C_PEC:
        return 0;
    }
    return -ENOTTY;
}

/* Pins: driver versions differ in the last numbers, so the direction of the data determines a read. */
static int control_gpio(unsigned long request, void *argument) {
    enum { REQUEST = 0x80, FREE, INPUT, OUTPUT };
    struct { unsigned int gpio; int value; } pin;
    int number = _IOC_NR(request), is_write = _IOC_DIR(request) & _IOC_WRITE,
        is_read = _IOC_DIR(request) & _IOC_READ;
    if (_IOC_TYPE(request) != 'G')
        return -ENOTTY;
    if (number == REQUEST || number == FREE || number == INPUT)
        return 0;
    if (copy_memory(&pin, argument, sizeof pin))
        return -EFAULT;
    if (is_read) {
        int64_t value = 0;
        int result = exchange(GPIO_GET, pin.gpio, NULL, 0, NULL, 0, &value);
        pin.value = value;
        return result < 0 || !copy_memory(argument, &pin, sizeof pin) ? result : -EFAULT;
    }
    return is_write ? exchange(GPIO_SET, pin.gpio, &pin.value, sizeof pin.value, NULL, 0, NULL) : -ENOTTY;
}

int ioctl(int fd, unsigned long request, ...) {
    int node = node_of_fd(fd);
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    switch (KIND(node)) {
    case I2C:
        return c_result(control_i2c(fd, node, request, argument));
    case GPIO:
        return c_result(control_gpio(request, argument));
    case PWM:
        return 0;
    default:
        return REAL(ioctl)(fd, request, argument);
    }
}

int __ioctl_time64(int fd, unsigned long request, void *argument) { return ioctl(fd, request, argument); }

/* Bytes -------------------------------------------------------------------------------------------------- */

ssize_t write(int fd, const void *content, size_t count) {
    int node = node_of_fd(fd);
    return KIND(node) == I2C ? transfer_one(node, 0, (void *)content, count)
                             : REAL(write)(fd, content, count);
}

ssize_t read(int fd, void *content, size_t count) {
    int node = node_of_fd(fd);
    if (KIND(node) == I2C)
        return transfer_one(node, 1, content, count);
    if (!simulated)
        return REAL(read)(fd, content, count);
    if (is_timer(fd))
        return read_timer(fd, content, count);
    struct pollfd poll_fd = {fd, POLLIN, 0};
    int blocks = fd >= 0 && !REAL(poll)(&poll_fd, 1, 0);
    if (blocks && wait_to_receive(fd, 0))
        return -1;
    ssize_t n = REAL(read)(fd, content, count);
    if (blocks)
        wait_turn();
    return n;
}

ssize_t __read_chk(int fd, void *content, size_t count, size_t size) { return read(fd, content, count); }

/* The bus ignores offsets, and each buffer is a message. */
static ssize_t transfer_buffers(int node, int is_read, const struct iovec *buffers, int count) {
    ssize_t total = 0;
    if (count < 0 || count > 1024)
        return c_result(-EINVAL);
    for (int i = 0; i < count; i++) {
        struct iovec buffer;
        ssize_t n = copy_memory(&buffer, buffers + i, sizeof buffer)
                        ? -1
                        : transfer_one(node, is_read, buffer.iov_base, buffer.iov_len);
        if (n < 0)
            return total ? total : -1;
        total += n;
        if ((size_t)n < buffer.iov_len)
            break;
    }
    return total;
}

#define BYTES_CALL(type, name, parameters, transfer, ...)                                                    \
    type name parameters {                                                                                   \
        int node = node_of_fd(fd);                                                                           \
        return KIND(node) == I2C ? transfer : REAL(name)(fd, __VA_ARGS__);                                   \
    }
#define OFFSET_CALLS(off, suffix)                                                                            \
    BYTES_CALL(ssize_t, pread##suffix, (int fd, void *content, size_t count, off offset),                    \
               transfer_one(node, 1, content, count), content, count, offset)                                \
    BYTES_CALL(ssize_t, pwrite##suffix, (int fd, const void *content, size_t count, off offset),             \
               transfer_one(node, 0, (void *)content, count), content, count, offset)                        \
    BYTES_CALL(ssize_t, preadv##suffix, (int fd, const struct iovec *buffers, int count, off offset),        \
               transfer_buffers(node, 1, buffers, count), buffers, count, offset)                            \
    BYTES_CALL(ssize_t, pwritev##suffix, (int fd, const struct iovec *buffers, int count, off offset),       \
               transfer_buffers(node, 0, buffers, count), buffers, count, offset)
OFFSET_CALLS(off_t, )
OFFSET_CALLS(off64_t, 64)
BYTES_CALL(ssize_t, readv, (int fd, const struct iovec *buffers, int count),
           transfer_buffers(node, 1, buffers, count), buffers, count)
BYTES_CALL(ssize_t, writev, (int fd, const struct iovec *buffers, int count),
           transfer_buffers(node, 0, buffers, count), buffers, count)
ssize_t __pread_chk(int fd, void *content, size_t count, off_t offset, size_t size) {
    return pread(fd, content, count, offset);
}
ssize_t __pread64_chk(int fd, void *content, size_t count, off64_t offset, size_t size) {
    return pread64(fd, content, count, offset);
}
