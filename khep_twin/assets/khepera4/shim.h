/* Parts of the preload library: `shim.c` has the devices, `shim_time.c` the clock, and
   `shim_locks.c` what threads wait for. */

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

enum kind { NOTHING, I2C, GPIO, PWM, LINE, TIMER };
enum question { TRANSFER = 1, GPIO_SET, GPIO_GET, NOW, SLEEP, HELLO, CANCEL, WAKE };
enum sleep { RELATIVE, ABSOLUTE };

#define MOST_HANDLES 4096
#define NEVER INT64_MAX
#define OWN __attribute__((visibility("hidden")))

/* The function that a name has without this library. */
#define REAL(name)                                                                                           \
    ({                                                                                                       \
        static __typeof__(&name) found;                                                                      \
        found ? found : (found = (__typeof__(&name))dlsym(RTLD_NEXT, #name));                                \
    })

extern OWN unsigned char kinds[MOST_HANDLES]; /* of the handles of this process */
extern OWN int simulated;

static inline enum kind kind_at(int handle) {
    return handle >= 0 && handle < MOST_HANDLES ? kinds[handle] : NOTHING;
}

static inline int failed(int result) {
    if (result >= 0)
        return result;
    errno = -result;
    return -1;
}

/* The end of a wait [ns]; by the second pair also at a wake of a place later than the one seen. */
struct limit { int64_t ns; uint64_t place, seen; };

OWN int ask(enum question, uint32_t number, const void *content, uint32_t count, void *back, uint32_t room,
            int64_t *value);
OWN int wait_until(enum sleep, struct limit, struct pollfd *handles, nfds_t count, const sigset_t *mask,
                   int64_t *left);
OWN void wake(uint32_t count, uint64_t place, uint64_t number);
OWN int out_of_the_way(int handle);
OWN void say_hello(void);
OWN void take_turn(void);
OWN void forget_timers(void);
OWN void forget_timer_of(int handle);
OWN void forget_locks(void);
OWN int64_t now(void);
OWN int64_t since_start(const struct timespec *time);
