/* Parts of the preload library: `shim.c` has the devices, `shim_time.c` the clock, and `shim_locks.c` the
   locks of threads. A futex address is that of a lock on which threads wait; "fd" is a file descriptor. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

enum kind { NOTHING, I2C, GPIO, PWM, CONNECTION, TIMER };
enum request { TRANSFER = 1, GPIO_SET, GPIO_GET, NOW, SLEEP, HELLO, CANCEL, WAKE };
enum sleep { RELATIVE, ABSOLUTE };

#define MAX_FDS 4096
#define NEVER INT64_MAX
#define HIDDEN __attribute__((visibility("hidden")))

/* The function of this name in the C library. */
#define REAL(name)                                                                                           \
    ({                                                                                                       \
        static __typeof__(&name) function;                                                                   \
        function ? function : (function = (__typeof__(&name))dlsym(RTLD_NEXT, #name));                       \
    })

extern HIDDEN unsigned char kinds[MAX_FDS]; /* by file descriptor */
extern HIDDEN int simulated;

static inline enum kind kind_of_fd(int fd) {
    return fd >= 0 && fd < MAX_FDS ? kinds[fd] : NOTHING;
}

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
HIDDEN int move_fd(int fd);
HIDDEN void say_hello(void);
HIDDEN void wait_turn(void);
HIDDEN void forget_timers(void);
HIDDEN void forget_timer_of(int fd);
HIDDEN void forget_locks(void);
HIDDEN int64_t now(void);
HIDDEN int64_t since_start(const struct timespec *time);
