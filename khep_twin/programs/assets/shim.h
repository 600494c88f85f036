/* Parts of the preload library. A futex address is that of a word on which threads wait; "fd" is a file
   descriptor.

       file              | functions that it replaces
       ------------------|--------------------------------------------------------------------
       shim.c            | threads and processes; requests to the twin
       shim_paths.c      | open, stat and other functions of a path
       shim_devices.c    | read, write, ioctl
       shim_programs.c   | exec, posix_spawn, system
       shim_time.c       | clocks, sleeps, waits for descriptors
       shim_timers.c     | timers
       shim_locks.c      | waits of threads for each other
       shim_system.c     | syscall
       shim_wide.c       | 64-bit times of 32-bit programs */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

/* A node: kind, whether its adapter sends messages of length 0, bus, address of the slave; 0 is none. */
enum kind { I2C = 1, GPIO, PWM };
#define KIND(node) ((node) >> 16)
#define SENDS_EMPTY(node) ((node) >> 15 & 1)
#define BUS(node) ((node) >> 8 & 0x7F)
#define SLAVE(node) ((node) & 0x7F)
enum request { TRANSFER = 1, GPIO_SET, GPIO_GET, NOW, SLEEP, HELLO, CANCEL, WAKE, EXEC };
enum sleep { RELATIVE, ABSOLUTE, EXTERNAL };
enum variable { PRELOAD, SOCKET, CLOCK, PATHS, FILES };

#define BILLION 1000000000LL
#define NEVER INT64_MAX
#define HIDDEN __attribute__((visibility("hidden")))

/* The function of this name in the C library. */
#define REAL(name)                                                                                           \
    ({                                                                                                       \
        static __typeof__(&name) function;                                                                   \
        function ? function : (function = (__typeof__(&name))dlsym(RTLD_NEXT, #name));                       \
    })

extern HIDDEN int simulated;

/* Define a function whose result is another with a simulated clock. */
#define REPLACE(name, parameters, arguments, result)                                                         \
    int name parameters { return simulated ? (result) : REAL(name) arguments; }

/* A file descriptor of this library. The program may close it, and its number may become another file's, so
   the kernel's number of the file is compared before each use. */
struct private { int fd; uint64_t inode; };

/* Return a result as the C library does: -1 and an error number if it is below 0. */
static inline int c_result(int result) {
    return result < 0 ? (errno = -result, -1) : result;
}

/* End of a wait [ns], or, if there is a futex address, a WAKE of it later than `last_wake`. */
struct limit { int64_t ns; uint64_t futex_address, last_wake; };

/* 64-bit timespec of 32-bit programs. */
struct wide { int64_t seconds; int32_t rest, unused; };

HIDDEN int exchange(enum request, uint32_t number, const void *content, uint32_t count, void *output,
                    uint32_t size, int64_t *value);
HIDDEN int wait_until(enum sleep, struct limit, struct pollfd *fds, nfds_t count, const sigset_t *mask,
                      int64_t *left);
HIDDEN void wake(uint32_t count, uint64_t futex_address, uint64_t number);
HIDDEN void say_hello(void);
HIDDEN void wait_turn(void);
HIDDEN struct private protect(int fd);
HIDDEN int is_open(struct private);
HIDDEN uint64_t socket_inode(int fd);

/* Copy as the kernel does: return 0, or -1 and EFAULT for an address that the program cannot access. */
HIDDEN int copy_memory(void *target, const void *source, size_t size);

/* Copy a path; return the copy, or the original if the program cannot access it: the kernel then reports
   EFAULT. */
HIDDEN const char *copy_path(const char *path, char *copy);

/* Return a variable of the environment in which the program started, or NULL. */
HIDDEN const char *twin_variable(enum variable);
HIDDEN void keep_variables(void);

HIDDEN int node_of_fd(int fd);
HIDDEN int open_node(int node, int flags);
HIDDEN void mark_node(int fd, int node);

HIDDEN int64_t now(void);
HIDDEN int64_t to_ns(int64_t seconds, int64_t ns);
HIDDEN int64_t since_start(const struct timespec *time);
HIDDEN int wait_to_receive(int fd, int flags);

HIDDEN void forget_timers(void);
HIDDEN int is_timer(int fd);
HIDDEN ssize_t read_timer(int fd, void *content, size_t size);

HIDDEN void forget_locks(void);
HIDDEN void notify(const void *address, uint32_t count);
HIDDEN uint64_t add_waiter(const void *address);
HIDDEN void remove_waiter(const void *address);
HIDDEN long call_futex(uint32_t *word, int operation, uint32_t value, const struct timespec *limit,
                       uint32_t *other_word, uint32_t other_value);

static inline struct timespec time_of(int64_t ns) { return (struct timespec){ns / BILLION, ns % BILLION}; }
static inline struct timeval us_of(int64_t ns) { return (struct timeval){ns / BILLION, ns % BILLION / 1000}; }
static inline int64_t ns_of(const struct timespec *time) { return to_ns(time->tv_sec, time->tv_nsec); }
static inline int64_t ns_of_us(const struct timeval *time) {
    return to_ns(time->tv_sec, time->tv_usec * 1000LL);
}
