/* Devices and clock of a Khepera IV for a program that was compiled on this machine.

   A preload library: LD_PRELOAD loads it before the C library, so that its functions replace those of the
   same names. It answers the device nodes of the robot and, with a simulated clock, the functions that return
   the time or wait, by requests to the twin on a socket, named in KHEP_TWIN_SOCKET. The server and the
   messages are in `khep_twin/khepera4/device_server.py`. */

#include "shim.h"

#include <dirent.h>
#include <fcntl.h>
#include <limits.h>
#include <sched.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>

#include <linux/i2c-dev.h>
#include <linux/i2c.h>

/* A signal handler that interrupts a sleeping thread uses another connection; after a longjmp out of it that
   connection stays open. */
#define MAX_CONNECTIONS 8
#define MAX_BYTES 131072

struct header { uint32_t kind, number, count; };
struct reply { int32_t result; uint32_t count; int64_t value; };

unsigned char kinds[MAX_FDS];
int simulated;
static unsigned short slaves[MAX_FDS];
static __thread struct { int fds[MAX_CONNECTIONS], depth; } connections; /* 0: not connected */
static pthread_key_t thread_end;

/* Connections -------------------------------------------------------------------------------------------- */

static void disconnect(void *unused) {
    for (int i = 0; i < MAX_CONNECTIONS; i++)
        if (connections.fds[i]) {
            kinds[connections.fds[i]] = NOTHING;
            REAL(close)(connections.fds[i]);
        }
    memset(&connections, 0, sizeof connections);
}

static void start_child(void) {
    for (int i = 0; i < MAX_FDS; i++)
        if (kinds[i] == CONNECTION) {
            kinds[i] = NOTHING;
            REAL(close)(i);
        }
    memset(&connections, 0, sizeof connections);
    forget_timers();
    forget_locks();
    say_hello();
}

__attribute__((constructor)) static void initialize(void) {
    const char *clock = getenv("KHEP_TWIN_CLOCK");
    simulated = clock && !strcmp(clock, "simulated");
    pthread_key_create(&thread_end, disconnect);
    pthread_atfork(NULL, NULL, start_child);
    if (!simulated)
        return;
    /* All threads share one processor; with SCHED_BATCH a woken thread does not preempt the running one. */
    sched_setscheduler(0, SCHED_BATCH, &(struct sched_param){0});
    say_hello();
}

/* Move a file descriptor of this library to a high number, and protect it from the program. */
int move_fd(int fd) {
    int high = fcntl(fd, F_DUPFD_CLOEXEC, 512);
    if (high >= 0)
        REAL(close)(fd);
    else
        high = fd;
    if (high >= 0 && high < MAX_FDS)
        kinds[high] = CONNECTION;
    return high;
}

static int transmit(int fd, void *content, size_t count, int out) {
    char *position = content;
    while (count) {
        ssize_t n = out ? send(fd, position, count, MSG_NOSIGNAL) : recv(fd, position, count, 0);
        if (n < 0 && errno == EINTR)
            continue;
        if (n <= 0)
            return -1;
        position += n;
        count -= n;
    }
    return 0;
}

/* End the program without its twin. */
static void exit_without_twin(void) {
    static const char message[] = "khep-twin: the twin has ended, and this program with it\n";
    (void)!REAL(write)(2, message, sizeof message - 1);
    _exit(1);
}

/* Return the connection for requests, or -1 outside a twin. A new one waits until it is scheduled. */
static int get_connection(void) {
    if (connections.depth == MAX_CONNECTIONS)
        disconnect(NULL);
    if (connections.fds[connections.depth])
        return connections.fds[connections.depth];
    const char *path = getenv("KHEP_TWIN_SOCKET");
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (!path || strlen(path) >= sizeof address.sun_path)
        return -1;
    strcpy(address.sun_path, path);
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0)
        return -1;
    struct header hello = {HELLO, gettid(), 0};
    struct reply reply;
    fd = move_fd(fd);
    if (fd >= MAX_FDS) {
        REAL(close)(fd);
        return -1;
    }
    if (connect(fd, (struct sockaddr *)&address, sizeof address) ||
        transmit(fd, &hello, sizeof hello, 1) || transmit(fd, &reply, sizeof reply, 0))
        exit_without_twin();
    pthread_setspecific(thread_end, &connections);
    return connections.fds[connections.depth] = fd;
}

/* Signals and cancellation of the thread are blocked during a request. */
struct state { sigset_t signals; int cancel; };

static void block(struct state *saved) {
    sigset_t signals;
    sigfillset(&signals);
    pthread_sigmask(SIG_BLOCK, &signals, &saved->signals);
    pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, &saved->cancel);
}

static void restore(const struct state *saved) {
    pthread_setcancelstate(saved->cancel, NULL);
    pthread_sigmask(SIG_SETMASK, &saved->signals, NULL);
}

void say_hello(void) {
    struct state saved;
    block(&saved);
    get_connection();
    restore(&saved);
}

/* Send a request and receive its reply; return the result, or minus an error number. */
int exchange(enum request kind, uint32_t number, const void *content, uint32_t count, void *output,
             uint32_t size, int64_t *value) {
    unsigned char buffer[256];
    struct header header = {kind, number, count};
    struct reply reply;
    int small = count <= sizeof buffer - sizeof header, result = -ENODEV, saved_errno = errno;
    struct state saved;
    block(&saved);
    int fd = get_connection();
    if (fd >= 0) {
        memcpy(buffer, &header, sizeof header);
        if (small && count)
            memcpy(buffer + sizeof header, content, count);
        if (transmit(fd, buffer, sizeof header + (small ? count : 0), 1) ||
            (!small && transmit(fd, (void *)content, count, 1)) || transmit(fd, &reply, sizeof reply, 0) ||
            reply.count > size || transmit(fd, output, reply.count, 0))
            exit_without_twin();
        result = reply.result;
        if (value)
            *value = reply.value;
    }
    restore(&saved);
    errno = saved_errno;
    return result;
}

/* Wait until a limit, or until file descriptors are ready; return 0, 1 after a WAKE, or minus an error number
   after a signal handler. `left` becomes the remaining time, below 0 if it took longer. */
int wait_until(enum sleep kind, struct limit limit, struct pollfd *fds, nfds_t count,
               const sigset_t *mask, int64_t *left) {
    struct { struct header header; struct limit limit; } __attribute__((packed)) message = {
        {SLEEP, kind, sizeof limit}, limit};
    struct header cancel = {CANCEL, 0, 0};
    struct reply reply;
    struct pollfd watched[count + 1];
    struct state saved;
    int error = 0, result = 0, saved_errno = errno;
    block(&saved);
    int connection = get_connection();
    if (connection >= 0) {
        if (count)
            memcpy(watched, fds, count * sizeof *fds);
        watched[count] = (struct pollfd){connection, POLLIN, 0};
        if (transmit(connection, &message, sizeof message, 1))
            exit_without_twin();
        connections.depth++;
        pthread_setcancelstate(saved.cancel, NULL);
        if (REAL(ppoll)(watched, count + 1, NULL, mask ? mask : &saved.signals) < 0) {
            error = errno;
            watched[count].revents = 0;
        }
        pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, NULL);
        connections.depth--;
        if ((!watched[count].revents && transmit(connection, &cancel, sizeof cancel, 1)) ||
            transmit(connection, &reply, sizeof reply, 0))
            exit_without_twin();
        result = reply.result;
        if (left)
            *left = reply.value;
    }
    restore(&saved);
    errno = saved_errno;
    return result ? result : -error;
}

/* Wait until all other threads wait: a thread that was just woken runs beside the one that woke it. */
void wait_turn(void) {
    if (simulated)
        wait_until(RELATIVE, (struct limit){0}, NULL, 0, NULL, NULL);
}

void wake(uint32_t count, uint64_t futex_address, uint64_t number) {
    struct { struct header header; uint64_t futex_address, number; } __attribute__((packed)) message = {
        {WAKE, count, sizeof futex_address + sizeof number}, futex_address, number};
    struct state saved;
    block(&saved);
    int connection = get_connection();
    if (connection >= 0 && transmit(connection, &message, sizeof message, 1))
        exit_without_twin();
    restore(&saved);
}

/* Threads and processes ---------------------------------------------------------------------------------- */

struct thread_start { void *(*routine)(void *); void *argument; };

static void *run_thread(void *argument) {
    struct thread_start start = *(struct thread_start *)argument;
    free(argument);
    say_hello();
    return start.routine(start.argument);
}

/* A new thread starts when its creator waits. */
int pthread_create(pthread_t *thread, const pthread_attr_t *attr, void *(*routine)(void *), void *argument) {
    struct thread_start *start = simulated ? malloc(sizeof *start) : NULL;
    if (!start)
        return REAL(pthread_create)(thread, attr, routine, argument);
    *start = (struct thread_start){routine, argument};
    int error = REAL(pthread_create)(thread, attr, run_thread, start);
    if (error)
        free(start);
    return error;
}

/* As fork, since the child would change this library's memory; the parent waits as for vfork. */
pid_t vfork(void) {
    int ends[2];
    char byte;
    if (pipe2(ends, O_CLOEXEC))
        return -1;
    for (int i = 0; i < 2; i++) {
        int fd = fcntl(ends[i], F_DUPFD_CLOEXEC, 512);
        REAL(close)(ends[i]);
        ends[i] = fd;
    }
    pid_t child = fork();
    if (!child) {
        REAL(close)(ends[0]);
        return 0;
    }
    REAL(close)(ends[1]);
    while (child > 0 && REAL(read)(ends[0], &byte, 1) < 0 && errno == EINTR)
        ;
    REAL(close)(ends[0]);
    return child;
}

/* Device nodes ------------------------------------------------------------------------------------------- */

static enum kind device_kind(const char *path) {
    if (!path || strncmp(path, "/dev/", 5))
        return NOTHING;
    if (!strncmp(path, "/dev/i2c-", 9))
        return I2C;
    if (!strcmp(path, "/dev/user-gpio"))
        return GPIO;
    return strncmp(path, "/dev/pwm", 8) ? NOTHING : PWM;
}

static int open_device(enum kind kind) {
    int fd = REAL(open)("/dev/null", O_RDWR | O_CLOEXEC);
    if (fd >= MAX_FDS) {
        REAL(close)(fd);
        return c_result(-EMFILE);
    }
    if (fd >= 0) {
        kinds[fd] = kind;
        slaves[fd] = 0;
    }
    return fd;
}

/* Redirect the robot's configuration files to a folder of the twin. */
static const char *redirect(const char *path, char *buffer) {
    const char *folder = getenv("KHEP_TWIN_ETC");
    static const char *const folders[] = {"/etc/libkhepera", "/etc/khepera"};
    for (int i = 0; folder && path && i < 2; i++) {
        size_t length = strlen(folders[i]);
        if (!strncmp(path, folders[i], length) && (!path[length] || path[length] == '/') &&
            snprintf(buffer, PATH_MAX, "%s%s", folder, path + 4) < PATH_MAX)
            return buffer;
    }
    return path;
}

#define DEFINE_OPEN(name, lead, pass)                                                                        \
    int name(lead const char *path, int flags, ...) {                                                        \
        char buffer[PATH_MAX];                                                                               \
        enum kind kind = device_kind(path);                                                                  \
        va_list rest;                                                                                        \
        va_start(rest, flags);                                                                               \
        mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;                            \
        va_end(rest);                                                                                        \
        return kind ? open_device(kind) : REAL(name)(pass redirect(path, buffer), flags, mode);              \
    }
#define NONE
#define FOLDER int folder,
#define AT folder,
DEFINE_OPEN(open, NONE, NONE)
DEFINE_OPEN(open64, NONE, NONE)
DEFINE_OPEN(openat, FOLDER, AT)
DEFINE_OPEN(openat64, FOLDER, AT)

int __open_2(const char *path, int flags) { return open(path, flags); }
int __open64_2(const char *path, int flags) { return open64(path, flags); }
int __openat_2(int folder, const char *path, int flags) { return openat(folder, path, flags); }
int __openat64_2(int folder, const char *path, int flags) { return openat64(folder, path, flags); }

/* A stream of a node serves only ioctl, by its file descriptor; its bytes are discarded. */
#define DEFINE_FOPEN(name)                                                                                   \
    FILE *name(const char *path, const char *mode) {                                                         \
        char buffer[PATH_MAX];                                                                               \
        int fd = device_kind(path) ? open_device(device_kind(path)) : -1;                                    \
        if (device_kind(path))                                                                               \
            return fd < 0 ? NULL : fdopen(fd, mode);                                                         \
        return REAL(name)(redirect(path, buffer), mode);                                                     \
    }
DEFINE_FOPEN(fopen)
DEFINE_FOPEN(fopen64)

/* Functions of a path: a node exists, and is a character device as /dev/null. */
#define PATH_CALL(type, name, parameters, before, after)                                                     \
    type name parameters {                                                                                   \
        char buffer[PATH_MAX];                                                                               \
        return REAL(name)(before device_kind(path) ? "/dev/null" : redirect(path, buffer) after);            \
    }
#define COMMA ,
PATH_CALL(int, access, (const char *path, int mode), , COMMA mode)
PATH_CALL(int, euidaccess, (const char *path, int mode), , COMMA mode)
PATH_CALL(int, eaccess, (const char *path, int mode), , COMMA mode)
PATH_CALL(int, faccessat, (int folder, const char *path, int mode, int flags), AT, COMMA mode COMMA flags)
PATH_CALL(int, stat, (const char *path, struct stat *status), , COMMA status)
PATH_CALL(int, stat64, (const char *path, struct stat64 *status), , COMMA status)
PATH_CALL(int, lstat, (const char *path, struct stat *status), , COMMA status)
PATH_CALL(int, lstat64, (const char *path, struct stat64 *status), , COMMA status)
PATH_CALL(int, fstatat, (int folder, const char *path, struct stat *status, int flags), AT,
      COMMA status COMMA flags)
PATH_CALL(int, fstatat64, (int folder, const char *path, struct stat64 *status, int flags), AT,
      COMMA status COMMA flags)
PATH_CALL(int, statx, (int folder, const char *path, int flags, unsigned int mask, struct statx *status), AT,
      COMMA flags COMMA mask COMMA status)
PATH_CALL(DIR *, opendir, (const char *path), , )

/* Names in programs for older C libraries, or of 32 bits with 64-bit times. */
extern int __xstat(int, const char *, void *), __xstat64(int, const char *, void *);
extern int __lxstat(int, const char *, void *), __lxstat64(int, const char *, void *);
extern int __stat64_time64(const char *, void *), __lstat64_time64(const char *, void *);
PATH_CALL(int, __xstat, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __xstat64, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __lxstat, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __lxstat64, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __stat64_time64, (const char *path, void *status), , COMMA status)
PATH_CALL(int, __lstat64_time64, (const char *path, void *status), , COMMA status)

static void forget(int fd) {
    if (kind_of_fd(fd) == TIMER)
        forget_timer_of(fd);
    if (kind_of_fd(fd))
        kinds[fd] = NOTHING;
}

int close(int fd) {
    if (kind_of_fd(fd) == CONNECTION)
        return c_result(-EBADF); /* for programs that close all possible descriptors */
    forget(fd);
    return REAL(close)(fd);
}

int close_range(unsigned int first, unsigned int last, int flags) {
    if (flags)
        return REAL(close_range)(first, last, flags);
    for (unsigned int i = first; i < MAX_FDS && i <= last; i++)
        close(i);
    first = first > MAX_FDS ? first : MAX_FDS;
    return first <= last ? REAL(close_range)(first, last, flags) : 0;
}

void closefrom(int first) { close_range(first, ~0u, 0); }

static int copied(int from, int to) {
    enum kind kind = kind_of_fd(from) == TIMER ? NOTHING : kind_of_fd(from);
    if (kind && to >= MAX_FDS) {
        REAL(close)(to);
        return c_result(-EMFILE);
    }
    if (to >= 0 && to < MAX_FDS && to != from) {
        forget(to);
        kinds[to] = kind;
        slaves[to] = kind ? slaves[from] : 0;
    }
    return to;
}

int dup(int fd) { return copied(fd, REAL(dup)(fd)); }

static int is_free(int fd) {
    if (kind_of_fd(fd) != CONNECTION)
        return 1;
    errno = EBUSY;
    return 0;
}

int dup2(int from, int to) { return is_free(to) ? copied(from, REAL(dup2)(from, to)) : -1; }
int dup3(int from, int to, int flags) { return is_free(to) ? copied(from, REAL(dup3)(from, to, flags)) : -1; }

static int transfer(struct i2c_msg *messages, uint32_t count) {
    unsigned char small_buffer[512], *out = small_buffer;
    size_t length = 0, n_read = 0;
    for (uint32_t i = 0; i < count; i++) {
        if (messages[i].len && !messages[i].buf)
            return -EFAULT;
        length += 3 * sizeof(uint16_t) + (messages[i].flags & I2C_M_RD ? 0 : messages[i].len);
        n_read += messages[i].flags & I2C_M_RD ? messages[i].len : 0;
    }
    if (length + n_read > MAX_BYTES)
        return -EINVAL;
    if (length + n_read > sizeof small_buffer && !(out = malloc(length + n_read)))
        return -ENOMEM;
    unsigned char *position = out, *reply = out + length;
    for (uint32_t i = 0; i < count; i++) {
        struct i2c_msg *message = &messages[i];
        uint16_t words[3] = {message->addr, message->flags, message->len};
        size_t content = message->flags & I2C_M_RD ? 0 : message->len;
        memcpy(position, words, sizeof words);
        memcpy(position + sizeof words, message->buf, content);
        position += sizeof words + content;
    }
    int result = exchange(TRANSFER, count, out, length, reply, n_read, NULL);
    for (uint32_t i = 0; result >= 0 && i < count; i++)
        if (messages[i].flags & I2C_M_RD) {
            memcpy(messages[i].buf, reply, messages[i].len);
            reply += messages[i].len;
        }
    if (out != small_buffer)
        free(out);
    return result;
}

static int transfer_one(int fd, int is_read, void *content, size_t count) {
    struct i2c_msg message = {slaves[fd], is_read ? I2C_M_RD : 0, count > 8192 ? 8192 : count, content};
    int result = transfer(&message, 1);
    return c_result(result < 0 ? result : message.len);
}

ssize_t write(int fd, const void *content, size_t count) {
    if (kind_of_fd(fd) == I2C)
        return transfer_one(fd, 0, (void *)content, count);
    return REAL(write)(fd, content, count);
}

ssize_t read(int fd, void *content, size_t count) {
    if (kind_of_fd(fd) == I2C)
        return transfer_one(fd, 1, content, count);
    struct pollfd poll_fd = {fd, POLLIN, 0};
    int blocks = simulated && fd >= 0 && !REAL(poll)(&poll_fd, 1, 0);
    ssize_t n = REAL(read)(fd, content, count);
    if (blocks)
        wait_turn();
    return n;
}

ssize_t __read_chk(int fd, void *content, size_t count, size_t size) { return read(fd, content, count); }

/* SMBus transfers: a byte as a probe, or a register and its content. */
static int smbus(int fd, struct i2c_smbus_ioctl_data *smbus_data) {
    unsigned char out[34], reply[32];
    int is_read = smbus_data->read_write == I2C_SMBUS_READ, length = 0;
    if (smbus_data->size != I2C_SMBUS_QUICK && !(smbus_data->size == I2C_SMBUS_BYTE && is_read))
        out[length++] = smbus_data->command;
    int size = smbus_data->size == I2C_SMBUS_WORD_DATA ? 2 : 1;
    if (smbus_data->size > I2C_SMBUS_WORD_DATA)
        return -EOPNOTSUPP;
    struct i2c_msg messages[2];
    int count = 0;
    if (!is_read && smbus_data->size >= I2C_SMBUS_BYTE_DATA) {
        memcpy(out + length, smbus_data->data, size);
        length += size;
    }
    if (length || smbus_data->size == I2C_SMBUS_QUICK)
        messages[count++] = (struct i2c_msg){slaves[fd], 0, length, out};
    if (is_read && smbus_data->size != I2C_SMBUS_QUICK)
        messages[count++] = (struct i2c_msg){slaves[fd], I2C_M_RD, size, reply};
    int result = transfer(messages, count);
    if (result >= 0 && is_read && smbus_data->size != I2C_SMBUS_QUICK)
        memcpy(smbus_data->data, reply, size);
    return result < 0 ? result : 0;
}

static int i2c_control(int fd, unsigned long request, void *argument) {
    struct i2c_rdwr_ioctl_data *data = argument;
    switch (request) {
    case I2C_SLAVE:
    case I2C_SLAVE_FORCE:
        slaves[fd] = (uintptr_t)argument;
        return (uintptr_t)argument > 0x7F ? -EINVAL : 0;
    case I2C_FUNCS:
        *(unsigned long *)argument = I2C_FUNC_I2C | I2C_FUNC_SMBUS_BYTE | I2C_FUNC_SMBUS_BYTE_DATA |
                                     I2C_FUNC_SMBUS_WORD_DATA | I2C_FUNC_SMBUS_QUICK;
        return 0;
    case I2C_RDWR:
        if (!data || !data->msgs)
            return -EFAULT;
        return data->nmsgs > I2C_RDWR_IOCTL_MAX_MSGS ? -EINVAL : transfer(data->msgs, data->nmsgs);
    case I2C_SMBUS:
        if (!argument)
            return -EFAULT;
        return smbus(fd, argument);
    case I2C_TIMEOUT:
    case I2C_RETRIES:
    case I2C_TENBIT:
    case I2C_PEC:
        return 0;
    }
    return -ENOTTY;
}

/* Pins: driver versions differ in the last numbers, so the direction of the data determines a read. */
static int gpio_control(unsigned long request, void *argument) {
    enum { REQUEST = 0x80, FREE, INPUT, OUTPUT };
    struct value { unsigned int gpio; int value; } *pin = argument;
    int number = _IOC_NR(request), is_write = _IOC_DIR(request) & _IOC_WRITE,
        is_read = _IOC_DIR(request) & _IOC_READ;
    if (_IOC_TYPE(request) != 'G')
        return -ENOTTY;
    if (number == REQUEST || number == FREE || number == INPUT)
        return 0;
    if (is_read) {
        int64_t value = 0;
        int result = exchange(GPIO_GET, pin->gpio, NULL, 0, NULL, 0, &value);
        pin->value = value;
        return result;
    }
    return is_write ? exchange(GPIO_SET, pin->gpio, &pin->value, sizeof pin->value, NULL, 0, NULL) : -ENOTTY;
}

int ioctl(int fd, unsigned long request, ...) {
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    switch (kind_of_fd(fd)) {
    case I2C:
        return c_result(i2c_control(fd, request, argument));
    case GPIO:
        return c_result(gpio_control(request, argument));
    case PWM:
        return 0;
    default:
        return REAL(ioctl)(fd, request, argument);
    }
}

int __ioctl_time64(int fd, unsigned long request, void *argument) { return ioctl(fd, request, argument); }
