/* Devices and clock of a Khepera IV for a program that was compiled on this machine.

   Loaded into the program by LD_PRELOAD. It answers the device nodes that programs of the robot open, and, with
   a simulated clock, the calls that ask for the time or wait. Each question goes to the twin on a socket, named in
   KHEP_TWIN_SOCKET; `khep_twin/khepera4/device_server.py` has the other end and describes the messages. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include <linux/i2c-dev.h>
#include <linux/i2c.h>

enum kind { NOTHING, I2C, GPIO, PWM, LINE };
enum question { TRANSFER = 1, GPIO_SET, GPIO_GET, NOW, SLEEP, HELLO };

#define MOST_HANDLES 4096
#define MOST_BYTES 65536
#define BILLION 1000000000LL

struct header { uint32_t question, number, count; };
struct answer { int32_t result; uint32_t count; int64_t value; };

static unsigned char kinds[MOST_HANDLES];
static unsigned short slaves[MOST_HANDLES];
static __thread int line = -1;
static __thread pid_t owner;
static pthread_key_t ended;
static int simulated;

#define REAL(name) ((__typeof__(&name))real(#name))

static void *real(const char *name) { return dlsym(RTLD_NEXT, name); }

static void forget(int handle) {
    if (handle < MOST_HANDLES)
        kinds[handle] = NOTHING;
    REAL(close)(handle);
}

static void end_of_thread(void *given) { forget((intptr_t)given - 1); }

__attribute__((constructor)) static void begin(void) {
    const char *clock = getenv("KHEP_TWIN_CLOCK");
    simulated = clock && !strcmp(clock, "simulated");
    pthread_key_create(&ended, end_of_thread);
}

/* Connect to the twin; each thread has a line of its own, also after a fork. */
static int connected(void) {
    if (line >= 0 && owner == getpid())
        return line;
    if (line >= 0)
        forget(line); /* that of the parent */
    line = -1;
    const char *path = getenv("KHEP_TWIN_SOCKET");
    struct sockaddr_un place = {.sun_family = AF_UNIX};
    if (!path || strlen(path) >= sizeof place.sun_path)
        return -1;
    strcpy(place.sun_path, path);
    int made = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (made >= 0 && connect(made, (struct sockaddr *)&place, sizeof place)) {
        REAL(close)(made);
        return -1;
    }
    /* Out of the way of programs that expect low numbers. */
    int high = fcntl(made, F_DUPFD_CLOEXEC, 512);
    if (high >= 0) {
        REAL(close)(made);
        made = high;
    }
    struct header hello = {HELLO, gettid(), 0};
    if (made < 0 || send(made, &hello, sizeof hello, MSG_NOSIGNAL) != sizeof hello)
        return -1;
    if (made < MOST_HANDLES)
        kinds[made] = LINE;
    pthread_setspecific(ended, (void *)((intptr_t)made + 1));
    line = made;
    owner = getpid();
    return line;
}

static int all(int handle, void *content, size_t count, int out) {
    char *at = content;
    while (count) {
        ssize_t done = out ? send(handle, at, count, MSG_NOSIGNAL) : recv(handle, at, count, 0);
        if (done < 0 && errno == EINTR)
            continue;
        if (done <= 0)
            return -1;
        at += done;
        count -= done;
    }
    return 0;
}

/* Ask the twin; return its result, or minus an error number. The program ends with its twin. */
static int ask(enum question question, uint32_t number, const void *content, uint32_t count, void *back,
               uint32_t room, int64_t *value) {
    struct header header = {question, number, count};
    struct answer answer;
    int result = -ENODEV, handle, lost = 1;
    if ((handle = connected()) >= 0 && !all(handle, &header, sizeof header, 1) &&
        !all(handle, (void *)content, count, 1) && !all(handle, &answer, sizeof answer, 0) && answer.count <= room &&
        !all(handle, back, answer.count, 0)) {
        lost = 0;
        result = answer.result;
        if (value)
            *value = answer.value;
    }
    if (lost && handle >= 0) {
        static const char told[] = "khep-twin: the twin has ended, and this program with it\n";
        REAL(write)(2, told, sizeof told - 1);
        _exit(1);
    }
    return result;
}

static int failed(int result) {
    if (result >= 0)
        return result;
    errno = -result;
    return -1;
}

/* Device nodes ---------------------------------------------------------------------------------------- */

static enum kind kind_of(const char *path) {
    if (!path || strncmp(path, "/dev/", 5))
        return NOTHING;
    if (!strncmp(path, "/dev/i2c-", 9))
        return I2C;
    if (!strcmp(path, "/dev/user-gpio"))
        return GPIO;
    return strncmp(path, "/dev/pwm", 8) ? NOTHING : PWM;
}

static int opened(enum kind kind) {
    int handle = REAL(open)("/dev/null", O_RDWR | O_CLOEXEC);
    if (handle >= MOST_HANDLES) {
        REAL(close)(handle);
        errno = EMFILE;
        return -1;
    }
    if (handle >= 0) {
        kinds[handle] = kind;
        slaves[handle] = 0;
    }
    return handle;
}

#define OPENING(name, lead, pass)                                                                                  \
    int name(lead const char *path, int flags, ...) {                                                              \
        enum kind kind = kind_of(path);                                                                            \
        va_list rest;                                                                                              \
        va_start(rest, flags);                                                                                     \
        mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;                                  \
        va_end(rest);                                                                                              \
        return kind ? opened(kind) : REAL(name)(pass path, flags, mode);                                           \
    }
#define NONE
#define FOLDER int folder,
#define AT folder,
OPENING(open, NONE, NONE)
OPENING(open64, NONE, NONE)
OPENING(openat, FOLDER, AT)
OPENING(openat64, FOLDER, AT)

int __open_2(const char *path, int flags) { return open(path, flags); }
int __open64_2(const char *path, int flags) { return open64(path, flags); }

static enum kind kind_at(int handle) { return handle >= 0 && handle < MOST_HANDLES ? kinds[handle] : NOTHING; }

int close(int handle) {
    if (kind_at(handle) == LINE) {
        errno = EBADF; /* a program that closes all that it may have */
        return -1;
    }
    if (kind_at(handle))
        kinds[handle] = NOTHING;
    return REAL(close)(handle);
}

static int copied(int from, int to) {
    if (kind_at(from) && to >= MOST_HANDLES) {
        REAL(close)(to);
        errno = EMFILE;
        return -1;
    }
    if (to >= 0 && to < MOST_HANDLES && to != from) {
        kinds[to] = kind_at(from);
        slaves[to] = kind_at(from) ? slaves[from] : 0;
    }
    return to;
}

int dup(int handle) { return copied(handle, REAL(dup)(handle)); }

static int may_be(int handle) {
    if (kind_at(handle) != LINE)
        return 1;
    errno = EBUSY;
    return 0;
}

int dup2(int from, int to) { return may_be(to) ? copied(from, REAL(dup2)(from, to)) : -1; }
int dup3(int from, int to, int flags) { return may_be(to) ? copied(from, REAL(dup3)(from, to, flags)) : -1; }

static int transfer(struct i2c_msg *messages, uint32_t count) {
    static __thread unsigned char out[MOST_BYTES], back[MOST_BYTES];
    size_t length = 0, wanted = 0;
    for (uint32_t i = 0; i < count; i++) {
        struct i2c_msg *message = &messages[i];
        uint16_t words[3] = {message->addr, message->flags, message->len};
        size_t content = message->flags & I2C_M_RD ? 0 : message->len;
        if (length + sizeof words + content > sizeof out)
            return -EINVAL;
        memcpy(out + length, words, sizeof words);
        memcpy(out + length + sizeof words, message->buf, content);
        length += sizeof words + content;
        wanted += message->flags & I2C_M_RD ? message->len : 0;
    }
    if (wanted > sizeof back)
        return -EINVAL;
    int result = ask(TRANSFER, count, out, length, back, sizeof back, NULL);
    unsigned char *at = back;
    for (uint32_t i = 0; result >= 0 && i < count; i++)
        if (messages[i].flags & I2C_M_RD) {
            memcpy(messages[i].buf, at, messages[i].len);
            at += messages[i].len;
        }
    return result;
}

static int one(int handle, int reads, void *content, size_t count) {
    struct i2c_msg message = {slaves[handle], reads ? I2C_M_RD : 0, count > 8192 ? 8192 : count, content};
    int result = transfer(&message, 1);
    return failed(result < 0 ? result : message.len);
}

ssize_t write(int handle, const void *content, size_t count) {
    if (kind_at(handle) == I2C)
        return one(handle, 0, (void *)content, count);
    return REAL(write)(handle, content, count);
}

ssize_t read(int handle, void *content, size_t count) {
    if (kind_at(handle) == I2C)
        return one(handle, 1, content, count);
    return REAL(read)(handle, content, count);
}

/* One byte as a probe, or a register and its content. */
static int smbus(int handle, struct i2c_smbus_ioctl_data *given) {
    unsigned char out[34], back[32];
    int reads = given->read_write == I2C_SMBUS_READ, length = 0;
    if (given->size != I2C_SMBUS_QUICK && !(given->size == I2C_SMBUS_BYTE && reads))
        out[length++] = given->command;
    int size = given->size == I2C_SMBUS_WORD_DATA ? 2 : 1;
    if (given->size > I2C_SMBUS_WORD_DATA)
        return -EOPNOTSUPP;
    struct i2c_msg messages[2];
    int count = 0;
    if (!reads && given->size >= I2C_SMBUS_BYTE_DATA) {
        memcpy(out + length, given->data, size);
        length += size;
    }
    if (length || given->size == I2C_SMBUS_QUICK)
        messages[count++] = (struct i2c_msg){slaves[handle], 0, length, out};
    if (reads && given->size != I2C_SMBUS_QUICK)
        messages[count++] = (struct i2c_msg){slaves[handle], I2C_M_RD, size, back};
    int result = transfer(messages, count);
    if (result >= 0 && reads && given->size != I2C_SMBUS_QUICK)
        memcpy(given->data, back, size);
    return result < 0 ? result : 0;
}

static int i2c_control(int handle, unsigned long request, void *argument) {
    struct i2c_rdwr_ioctl_data *both = argument;
    switch (request) {
    case I2C_SLAVE:
    case I2C_SLAVE_FORCE:
        slaves[handle] = (uintptr_t)argument;
        return (uintptr_t)argument > 0x7F ? -EINVAL : 0;
    case I2C_FUNCS:
        *(unsigned long *)argument = I2C_FUNC_I2C | I2C_FUNC_SMBUS_BYTE | I2C_FUNC_SMBUS_BYTE_DATA |
                                     I2C_FUNC_SMBUS_WORD_DATA | I2C_FUNC_SMBUS_QUICK;
        return 0;
    case I2C_RDWR:
        return both->nmsgs > I2C_RDWR_IOCTL_MAX_MSGS ? -EINVAL : transfer(both->msgs, both->nmsgs);
    case I2C_SMBUS:
        return smbus(handle, argument);
    case I2C_TIMEOUT:
    case I2C_RETRIES:
    case I2C_TENBIT:
    case I2C_PEC:
        return 0;
    }
    return -ENOTTY;
}

/* Pins: two versions of the driver differ in the last numbers, so the direction of the data tells a reading. */
static int gpio_control(unsigned long request, void *argument) {
    enum { REQUEST = 0x80, FREE, INPUT, OUTPUT };
    struct value { unsigned int gpio; int value; } *given = argument;
    int number = _IOC_NR(request), writes = _IOC_DIR(request) & _IOC_WRITE, reads = _IOC_DIR(request) & _IOC_READ;
    if (_IOC_TYPE(request) != 'G')
        return -ENOTTY;
    if (number == REQUEST || number == FREE || number == INPUT)
        return 0;
    if (reads) {
        int64_t value = 0;
        int result = ask(GPIO_GET, given->gpio, NULL, 0, NULL, 0, &value);
        given->value = value;
        return result;
    }
    return writes ? ask(GPIO_SET, given->gpio, &given->value, sizeof given->value, NULL, 0, NULL) : -ENOTTY;
}

int ioctl(int handle, unsigned long request, ...) {
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    switch (kind_at(handle)) {
    case I2C:
        return failed(i2c_control(handle, request, argument));
    case GPIO:
        return failed(gpio_control(request, argument));
    case PWM:
        return 0;
    case NOTHING:
    case LINE:
        break;
    }
    return REAL(ioctl)(handle, request, argument);
}

/* Time ------------------------------------------------------------------------------------------------ */

static int64_t now(void) {
    int64_t value = 0;
    ask(NOW, 0, NULL, 0, NULL, 0, &value);
    return value;
}

static void wait_for(int64_t ns) {
    if (ns > 0)
        ask(SLEEP, 0, &ns, sizeof ns, NULL, 0, NULL);
}

static int64_t ns_of(const struct timespec *time) { return time->tv_sec * BILLION + time->tv_nsec; }

int usleep(useconds_t us) {
    if (!simulated)
        return REAL(usleep)(us);
    wait_for(us * 1000LL);
    return 0;
}

unsigned int sleep(unsigned int seconds) {
    if (!simulated)
        return REAL(sleep)(seconds);
    wait_for(seconds * BILLION);
    return 0;
}

int nanosleep(const struct timespec *wanted, struct timespec *left) {
    if (!simulated)
        return REAL(nanosleep)(wanted, left);
    wait_for(ns_of(wanted));
    if (left)
        *left = (struct timespec){0, 0};
    return 0;
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *wanted, struct timespec *left) {
    if (!simulated)
        return REAL(clock_nanosleep)(clock, flags, wanted, left);
    wait_for(flags & TIMER_ABSTIME ? ns_of(wanted) - now() : ns_of(wanted));
    return 0;
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    if (!simulated || clock == CLOCK_PROCESS_CPUTIME_ID || clock == CLOCK_THREAD_CPUTIME_ID)
        return REAL(clock_gettime)(clock, time);
    int64_t ns = now();
    *time = (struct timespec){ns / BILLION, ns % BILLION};
    return 0;
}

int gettimeofday(struct timeval *time, void *zone) {
    if (!simulated)
        return REAL(gettimeofday)(time, zone);
    int64_t ns = now();
    *time = (struct timeval){ns / BILLION, ns % BILLION / 1000};
    return 0;
}

time_t time(time_t *place) {
    time_t found = simulated ? now() / BILLION : REAL(time)(place);
    if (place)
        *place = found;
    return found;
}

/* What is ready at once is; otherwise the whole time passes, as nothing but the twin changes meanwhile. */
int poll(struct pollfd *handles, nfds_t count, int ms) {
    if (!simulated || ms <= 0)
        return REAL(poll)(handles, count, ms);
    int found = REAL(poll)(handles, count, 0);
    if (found)
        return found;
    wait_for(ms * 1000000LL);
    return REAL(poll)(handles, count, 0);
}

int select(int count, fd_set *in, fd_set *out, fd_set *odd, struct timeval *limit) {
    if (!simulated || !limit)
        return REAL(select)(count, in, out, odd, limit);
    fd_set none, sets[3];
    struct timeval zero = {0, 0};
    FD_ZERO(&none);
    sets[0] = in ? *in : none;
    sets[1] = out ? *out : none;
    sets[2] = odd ? *odd : none;
    int found = REAL(select)(count, in, out, odd, &zero);
    if (found)
        return found;
    wait_for(limit->tv_sec * BILLION + limit->tv_usec * 1000LL);
    zero = (struct timeval){0, 0};
    if (in)
        *in = sets[0];
    if (out)
        *out = sets[1];
    if (odd)
        *odd = sets[2];
    return REAL(select)(count, in, out, odd, &zero);
}
