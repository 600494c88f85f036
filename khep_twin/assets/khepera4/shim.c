/* Devices and clock of a Khepera IV for a program that was compiled on this machine.

   Loaded into the program by LD_PRELOAD. It answers the device nodes that programs of the robot open, and,
   with a simulated clock, the calls that ask for the time or wait. Each question goes to the twin on a
   socket, named in KHEP_TWIN_SOCKET; `khep_twin/khepera4/device_server.py` has the other end and describes
   the messages. */

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

/* A handler of a signal that comes while its thread sleeps asks on a line of its own; one that leaves by
   longjmp leaves its line behind. */
#define MOST_LINES 8
#define MOST_BYTES 131072

struct header { uint32_t question, number, count; };
struct answer { int32_t result; uint32_t count; int64_t value; };

unsigned char kinds[MOST_HANDLES];
int simulated;
static unsigned short slaves[MOST_HANDLES];
static __thread struct { int handles[MOST_LINES], depth; } lines; /* 0: not connected */
static pthread_key_t ended;

/* Lines -------------------------------------------------------------------------------------------------- */

static void hang_up(void *unused) {
    (void)unused;
    for (int i = 0; i < MOST_LINES; i++)
        if (lines.handles[i]) {
            kinds[lines.handles[i]] = NOTHING;
            REAL(close)(lines.handles[i]);
        }
    memset(&lines, 0, sizeof lines);
}

static void begin_child(void) {
    for (int i = 0; i < MOST_HANDLES; i++)
        if (kinds[i] == LINE) {
            kinds[i] = NOTHING;
            REAL(close)(i);
        }
    memset(&lines, 0, sizeof lines);
    forget_timers();
    forget_locks();
    say_hello();
}

__attribute__((constructor)) static void begin(void) {
    const char *clock = getenv("KHEP_TWIN_CLOCK");
    simulated = clock && !strcmp(clock, "simulated");
    pthread_key_create(&ended, hang_up);
    pthread_atfork(NULL, NULL, begin_child);
    if (!simulated)
        return;
    /* On the one processor of the twin a thread mostly runs on until it waits, unless those whom it wakes
       interrupt it. */
    sched_setscheduler(0, SCHED_BATCH, &(struct sched_param){0});
    say_hello();
}

/* Copy a handle of this library to where programs do not expect one, and guard it from them. */
int out_of_the_way(int handle) {
    int high = fcntl(handle, F_DUPFD_CLOEXEC, 512);
    if (high >= 0)
        REAL(close)(handle);
    else
        high = handle;
    if (high >= 0 && high < MOST_HANDLES)
        kinds[high] = LINE;
    return high;
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

/* The program ends with its twin. */
static void lose(void) {
    static const char told[] = "khep-twin: the twin has ended, and this program with it\n";
    if (REAL(write)(2, told, sizeof told - 1))
        _exit(1);
    _exit(1);
}

/* Return the line on which to ask, or -1 outside a twin. A new one waits for its turn. */
static int connected(void) {
    if (lines.depth == MOST_LINES)
        hang_up(NULL);
    if (lines.handles[lines.depth])
        return lines.handles[lines.depth];
    const char *path = getenv("KHEP_TWIN_SOCKET");
    struct sockaddr_un place = {.sun_family = AF_UNIX};
    if (!path || strlen(path) >= sizeof place.sun_path)
        return -1;
    strcpy(place.sun_path, path);
    int made = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (made < 0)
        return -1;
    struct header hello = {HELLO, gettid(), 0};
    struct answer answer;
    made = out_of_the_way(made);
    if (made >= MOST_HANDLES) {
        REAL(close)(made);
        return -1;
    }
    if (connect(made, (struct sockaddr *)&place, sizeof place) || all(made, &hello, sizeof hello, 1) ||
        all(made, &answer, sizeof answer, 0))
        lose();
    pthread_setspecific(ended, &lines);
    return lines.handles[lines.depth] = made;
}

/* Signals and a cancellation of the thread come before or after a question, not within. */
struct state { sigset_t signals; int cancel; };

static void block(struct state *before) {
    sigset_t every;
    sigfillset(&every);
    pthread_sigmask(SIG_BLOCK, &every, &before->signals);
    pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, &before->cancel);
}

static void restore(const struct state *before) {
    pthread_setcancelstate(before->cancel, NULL);
    pthread_sigmask(SIG_SETMASK, &before->signals, NULL);
}

void say_hello(void) {
    struct state before;
    block(&before);
    connected();
    restore(&before);
}

/* Ask the twin; return its result, or minus an error number. */
int ask(enum question question, uint32_t number, const void *content, uint32_t count, void *back,
        uint32_t room, int64_t *value) {
    unsigned char together[256];
    struct header header = {question, number, count};
    struct answer answer;
    int small = count <= sizeof together - sizeof header, result = -ENODEV, kept = errno;
    struct state before;
    block(&before);
    int handle = connected();
    if (handle >= 0) {
        memcpy(together, &header, sizeof header);
        if (small && count)
            memcpy(together + sizeof header, content, count);
        if (all(handle, together, sizeof header + (small ? count : 0), 1) ||
            (!small && all(handle, (void *)content, count, 1)) || all(handle, &answer, sizeof answer, 0) ||
            answer.count > room || all(handle, back, answer.count, 0))
            lose();
        result = answer.result;
        if (value)
            *value = answer.value;
    }
    restore(&before);
    errno = kept;
    return result;
}

/* Wait for a time, or until handles are ready; return 0, 1 after a wake, or minus an error number: a handler
   of a signal ran. `left` becomes what is left of the time, below 0 where it took longer. */
int wait_until(enum sleep kind, struct limit limit, struct pollfd *handles, nfds_t count,
               const sigset_t *mask, int64_t *left) {
    struct { struct header header; struct limit limit; } __attribute__((packed)) message = {
        {SLEEP, kind, sizeof limit}, limit};
    struct header cancel = {CANCEL, 0, 0};
    struct answer answer;
    struct pollfd watched[count + 1];
    struct state before;
    int error = 0, result = 0, kept = errno;
    block(&before);
    int line = connected();
    if (line >= 0) {
        if (count)
            memcpy(watched, handles, count * sizeof *handles);
        watched[count] = (struct pollfd){line, POLLIN, 0};
        if (all(line, &message, sizeof message, 1))
            lose();
        lines.depth++;
        pthread_setcancelstate(before.cancel, NULL);
        if (REAL(ppoll)(watched, count + 1, NULL, mask ? mask : &before.signals) < 0) {
            error = errno;
            watched[count].revents = 0;
        }
        pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, NULL);
        lines.depth--;
        if ((!watched[count].revents && all(line, &cancel, sizeof cancel, 1)) ||
            all(line, &answer, sizeof answer, 0))
            lose();
        result = answer.result;
        if (left)
            *left = answer.value;
    }
    restore(&before);
    errno = kept;
    return result ? result : -error;
}

/* Wait until all others wait: for one that has just been woken, and runs beside the one that did it. */
void take_turn(void) {
    if (simulated)
        wait_until(RELATIVE, (struct limit){0}, NULL, 0, NULL, NULL);
}

void wake(uint32_t count, uint64_t place, uint64_t number) {
    struct { struct header header; uint64_t place, number; } __attribute__((packed)) message = {
        {WAKE, count, sizeof place + sizeof number}, place, number};
    struct state before;
    block(&before);
    int line = connected();
    if (line >= 0 && all(line, &message, sizeof message, 1))
        lose();
    restore(&before);
}

/* Threads and processes ---------------------------------------------------------------------------------- */

struct beginning { void *(*routine)(void *); void *argument; };

static void *begin_thread(void *given) {
    struct beginning own = *(struct beginning *)given;
    free(given);
    say_hello();
    return own.routine(own.argument);
}

/* A new thread begins when the one that made it waits. */
int pthread_create(pthread_t *made, const pthread_attr_t *how, void *(*routine)(void *), void *argument) {
    struct beginning *own = simulated ? malloc(sizeof *own) : NULL;
    if (!own)
        return REAL(pthread_create)(made, how, routine, argument);
    *own = (struct beginning){routine, argument};
    int error = REAL(pthread_create)(made, how, begin_thread, own);
    if (error)
        free(own);
    return error;
}

/* With its own memory, as the child would change what this library keeps; the parent waits as it does. */
pid_t vfork(void) {
    int ends[2];
    char none;
    if (pipe2(ends, O_CLOEXEC))
        return -1;
    for (int i = 0; i < 2; i++) {
        int high = fcntl(ends[i], F_DUPFD_CLOEXEC, 512);
        REAL(close)(ends[i]);
        ends[i] = high;
    }
    pid_t child = fork();
    if (!child) {
        REAL(close)(ends[0]);
        return 0;
    }
    REAL(close)(ends[1]);
    while (child > 0 && REAL(read)(ends[0], &none, 1) < 0 && errno == EINTR)
        ;
    REAL(close)(ends[0]);
    return child;
}

/* Device nodes ------------------------------------------------------------------------------------------- */

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

/* Where the robot's files lie: those of K-Team's library in a folder of the twin. */
static const char *place_of(const char *path, char *room) {
    const char *folder = getenv("KHEP_TWIN_ETC");
    static const char *const own[] = {"/etc/libkhepera", "/etc/khepera"};
    for (int i = 0; folder && path && i < 2; i++) {
        size_t length = strlen(own[i]);
        if (!strncmp(path, own[i], length) && (!path[length] || path[length] == '/') &&
            snprintf(room, PATH_MAX, "%s%s", folder, path + 4) < PATH_MAX)
            return room;
    }
    return path;
}

#define OPENING(name, lead, pass)                                                                            \
    int name(lead const char *path, int flags, ...) {                                                        \
        char room[PATH_MAX];                                                                                 \
        enum kind kind = kind_of(path);                                                                      \
        va_list rest;                                                                                        \
        va_start(rest, flags);                                                                               \
        mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;                            \
        va_end(rest);                                                                                        \
        return kind ? opened(kind) : REAL(name)(pass place_of(path, room), flags, mode);                     \
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
int __openat_2(int folder, const char *path, int flags) { return openat(folder, path, flags); }
int __openat64_2(int folder, const char *path, int flags) { return openat64(folder, path, flags); }

/* A stream of a node has its handle, for ioctl; the bytes of the stream itself go nowhere. */
#define STREAM(name)                                                                                         \
    FILE *name(const char *path, const char *mode) {                                                         \
        char room[PATH_MAX];                                                                                 \
        int handle = kind_of(path) ? opened(kind_of(path)) : -1;                                             \
        if (kind_of(path))                                                                                   \
            return handle < 0 ? NULL : fdopen(handle, mode);                                                 \
        return REAL(name)(place_of(path, room), mode);                                                       \
    }
STREAM(fopen)
STREAM(fopen64)

/* Questions about a path: a node is there, and a character device, as /dev/null is. */
#define ABOUT(type, name, parameters, before, after)                                                         \
    type name parameters {                                                                                   \
        char room[PATH_MAX];                                                                                 \
        return REAL(name)(before kind_of(path) ? "/dev/null" : place_of(path, room) after);                  \
    }
#define COMMA ,
ABOUT(int, access, (const char *path, int mode), , COMMA mode)
ABOUT(int, euidaccess, (const char *path, int mode), , COMMA mode)
ABOUT(int, eaccess, (const char *path, int mode), , COMMA mode)
ABOUT(int, faccessat, (int folder, const char *path, int mode, int flags), AT, COMMA mode COMMA flags)
ABOUT(int, stat, (const char *path, struct stat *found), , COMMA found)
ABOUT(int, stat64, (const char *path, struct stat64 *found), , COMMA found)
ABOUT(int, lstat, (const char *path, struct stat *found), , COMMA found)
ABOUT(int, lstat64, (const char *path, struct stat64 *found), , COMMA found)
ABOUT(int, fstatat, (int folder, const char *path, struct stat *found, int flags), AT,
      COMMA found COMMA flags)
ABOUT(int, fstatat64, (int folder, const char *path, struct stat64 *found, int flags), AT,
      COMMA found COMMA flags)
ABOUT(int, statx, (int folder, const char *path, int flags, unsigned int mask, struct statx *found), AT,
      COMMA flags COMMA mask COMMA found)
ABOUT(DIR *, opendir, (const char *path), , )

/* As programs of an older C library, or of 32 bits with times of 64, ask. */
extern int __xstat(int, const char *, void *), __xstat64(int, const char *, void *);
extern int __lxstat(int, const char *, void *), __lxstat64(int, const char *, void *);
extern int __stat64_time64(const char *, void *), __lstat64_time64(const char *, void *);
ABOUT(int, __xstat, (int version, const char *path, void *found), version COMMA, COMMA found)
ABOUT(int, __xstat64, (int version, const char *path, void *found), version COMMA, COMMA found)
ABOUT(int, __lxstat, (int version, const char *path, void *found), version COMMA, COMMA found)
ABOUT(int, __lxstat64, (int version, const char *path, void *found), version COMMA, COMMA found)
ABOUT(int, __stat64_time64, (const char *path, void *found), , COMMA found)
ABOUT(int, __lstat64_time64, (const char *path, void *found), , COMMA found)

static void forget(int handle) {
    if (kind_at(handle) == TIMER)
        forget_timer_of(handle);
    if (kind_at(handle))
        kinds[handle] = NOTHING;
}

int close(int handle) {
    if (kind_at(handle) == LINE) {
        errno = EBADF; /* a program that closes all that it may have */
        return -1;
    }
    forget(handle);
    return REAL(close)(handle);
}

int close_range(unsigned int first, unsigned int last, int flags) {
    if (flags)
        return REAL(close_range)(first, last, flags);
    for (unsigned int i = first; i < MOST_HANDLES && i <= last; i++)
        close(i);
    first = first > MOST_HANDLES ? first : MOST_HANDLES;
    return first <= last ? REAL(close_range)(first, last, flags) : 0;
}

void closefrom(int first) { close_range(first, ~0u, 0); }

static int copied(int from, int to) {
    enum kind kind = kind_at(from) == TIMER ? NOTHING : kind_at(from);
    if (kind && to >= MOST_HANDLES) {
        REAL(close)(to);
        errno = EMFILE;
        return -1;
    }
    if (to >= 0 && to < MOST_HANDLES && to != from) {
        forget(to);
        kinds[to] = kind;
        slaves[to] = kind ? slaves[from] : 0;
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
    unsigned char little[512], *out = little;
    size_t length = 0, wanted = 0;
    for (uint32_t i = 0; i < count; i++) {
        if (messages[i].len && !messages[i].buf)
            return -EFAULT;
        length += 3 * sizeof(uint16_t) + (messages[i].flags & I2C_M_RD ? 0 : messages[i].len);
        wanted += messages[i].flags & I2C_M_RD ? messages[i].len : 0;
    }
    if (length + wanted > MOST_BYTES)
        return -EINVAL;
    if (length + wanted > sizeof little && !(out = malloc(length + wanted)))
        return -ENOMEM;
    unsigned char *at = out, *back = out + length;
    for (uint32_t i = 0; i < count; i++) {
        struct i2c_msg *message = &messages[i];
        uint16_t words[3] = {message->addr, message->flags, message->len};
        size_t content = message->flags & I2C_M_RD ? 0 : message->len;
        memcpy(at, words, sizeof words);
        memcpy(at + sizeof words, message->buf, content);
        at += sizeof words + content;
    }
    int result = ask(TRANSFER, count, out, length, back, wanted, NULL);
    for (uint32_t i = 0; result >= 0 && i < count; i++)
        if (messages[i].flags & I2C_M_RD) {
            memcpy(messages[i].buf, back, messages[i].len);
            back += messages[i].len;
        }
    if (out != little)
        free(out);
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
    struct pollfd own = {handle, POLLIN, 0};
    int waits = simulated && handle >= 0 && !REAL(poll)(&own, 1, 0);
    ssize_t found = REAL(read)(handle, content, count);
    if (waits)
        take_turn();
    return found;
}

ssize_t __read_chk(int handle, void *content, size_t count, size_t room) {
    (void)room;
    return read(handle, content, count);
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
        if (!both || !both->msgs)
            return -EFAULT;
        return both->nmsgs > I2C_RDWR_IOCTL_MAX_MSGS ? -EINVAL : transfer(both->msgs, both->nmsgs);
    case I2C_SMBUS:
        if (!argument)
            return -EFAULT;
        return smbus(handle, argument);
    case I2C_TIMEOUT:
    case I2C_RETRIES:
    case I2C_TENBIT:
    case I2C_PEC:
        return 0;
    }
    return -ENOTTY;
}

/* Pins: two versions of the driver differ in the last numbers, so the direction of the data tells reading. */
static int gpio_control(unsigned long request, void *argument) {
    enum { REQUEST = 0x80, FREE, INPUT, OUTPUT };
    struct value { unsigned int gpio; int value; } *given = argument;
    int number = _IOC_NR(request), writes = _IOC_DIR(request) & _IOC_WRITE,
        reads = _IOC_DIR(request) & _IOC_READ;
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
    case TIMER:
        break;
    }
    return REAL(ioctl)(handle, request, argument);
}

int __ioctl_time64(int handle, unsigned long request, void *argument) {
    return ioctl(handle, request, argument);
}
