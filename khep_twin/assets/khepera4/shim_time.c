/* The simulated clock of the preload library: calls that ask for the time, wait for one, or set a timer.

   Times are those of the twin [ns], from 0 on. CLOCK_REALTIME began at `FIRST_DAY`, all other clocks at 0. */

#include "shim.h"

#include <limits.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/timeb.h>
#include <sys/timerfd.h>
#include <sys/times.h>

#define BILLION 1000000000LL
#define FIRST_DAY (1767225600 * BILLION) /* 2026-01-01, 0:00 UTC */

int64_t now(void) {
    int64_t value = 0;
    ask(NOW, 0, NULL, 0, NULL, 0, &value);
    return value;
}

static int64_t most(int64_t seconds, int64_t ns) {
    return seconds > NEVER / 2 / BILLION ? NEVER / 2 : seconds * BILLION + ns;
}
static int64_t ns_of(const struct timespec *time) { return most(time->tv_sec, time->tv_nsec); }
static int64_t ns_of_us(const struct timeval *time) { return most(time->tv_sec, time->tv_usec * 1000LL); }

/* Return the twin's time for one of any clock: those that began at 0 have not come to the first day. */
int64_t since_start(const struct timespec *time) {
    int64_t ns = ns_of(time);
    return ns >= FIRST_DAY ? ns - FIRST_DAY : ns;
}

static struct timespec time_of(int64_t ns) { return (struct timespec){ns / BILLION, ns % BILLION}; }
static struct timeval us_of(int64_t ns) { return (struct timeval){ns / BILLION, ns % BILLION / 1000}; }

/* Clocks ------------------------------------------------------------------------------------------------- */

int clock_gettime(clockid_t clock, struct timespec *time) {
    if (!simulated)
        return REAL(clock_gettime)(clock, time);
    int dated = clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE || clock == CLOCK_TAI;
    *time = time_of(now() + (dated ? FIRST_DAY : 0));
    return 0;
}

int clock_getres(clockid_t clock, struct timespec *time) {
    if (!simulated)
        return REAL(clock_getres)(clock, time);
    if (time)
        *time = time_of(1);
    return 0;
}

int gettimeofday(struct timeval *time, void *zone) {
    if (!simulated)
        return REAL(gettimeofday)(time, zone);
    *time = us_of(now() + FIRST_DAY);
    return 0;
}

time_t time(time_t *place) {
    time_t found = simulated ? (now() + FIRST_DAY) / BILLION : REAL(time)(NULL);
    if (place)
        *place = found;
    return found;
}

int timespec_get(struct timespec *time, int base) {
    if (!simulated || base != TIME_UTC)
        return REAL(timespec_get)(time, base);
    *time = time_of(now() + FIRST_DAY);
    return base;
}

int ftime(struct timeb *time) {
    int64_t ms = simulated ? (now() + FIRST_DAY) / 1000000 : 0;
    if (!simulated) {
        struct timespec real;
        REAL(clock_gettime)(CLOCK_REALTIME, &real);
        ms = ns_of(&real) / 1000000;
    }
    *time = (struct timeb){.time = ms / 1000, .millitm = ms % 1000};
    return 0;
}

/* The time of the processor is all the time that passes. */
clock_t clock(void) { return simulated ? now() / (BILLION / CLOCKS_PER_SEC) : REAL(clock)(); }

clock_t times(struct tms *place) {
    if (!simulated)
        return REAL(times)(place);
    clock_t ticks = now() / (BILLION / sysconf(_SC_CLK_TCK));
    if (place)
        *place = (struct tms){.tms_utime = ticks};
    return ticks;
}

/* A clock of the computer is not the robot's to set. */
int clock_settime(clockid_t clock, const struct timespec *time) {
    return simulated ? failed(-EPERM) : REAL(clock_settime)(clock, time);
}
int settimeofday(const struct timeval *time, const struct timezone *zone) {
    return simulated ? failed(-EPERM) : REAL(settimeofday)(time, zone);
}

/* Waits for a time --------------------------------------------------------------------------------------- */

int usleep(useconds_t us) {
    return simulated ? failed(wait_until(RELATIVE, (struct limit){us * 1000LL}, NULL, 0, NULL, NULL))
                     : REAL(usleep)(us);
}

unsigned int sleep(unsigned int seconds) {
    int64_t left = 0;
    if (!simulated)
        return REAL(sleep)(seconds);
    return wait_until(RELATIVE, (struct limit){seconds * BILLION}, NULL, 0, NULL, &left) && left > 0
               ? (left + BILLION / 2) / BILLION
               : 0;
}

/* Return 0 or an error number. */
static int nap(enum sleep kind, const struct timespec *wanted, struct timespec *left) {
    int64_t rest = 0;
    if (wanted->tv_sec < 0 || wanted->tv_nsec < 0 || wanted->tv_nsec >= BILLION)
        return EINVAL;
    struct limit limit = {kind == ABSOLUTE ? since_start(wanted) : ns_of(wanted)};
    int error = -wait_until(kind, limit, NULL, 0, NULL, &rest);
    if (error && left && kind == RELATIVE)
        *left = time_of(rest > 0 ? rest : 0);
    return error;
}

int nanosleep(const struct timespec *wanted, struct timespec *left) {
    return simulated ? failed(-nap(RELATIVE, wanted, left)) : REAL(nanosleep)(wanted, left);
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *wanted, struct timespec *left) {
    if (!simulated)
        return REAL(clock_nanosleep)(clock, flags, wanted, left);
    return nap(flags & TIMER_ABSTIME ? ABSOLUTE : RELATIVE, wanted, left);
}

/* Waits for handles -------------------------------------------------------------------------------------- */

/* Return how many are ready, or minus an error number; a limit below 0 is none. */
static int ready(struct pollfd *handles, nfds_t count, int64_t ns, const sigset_t *mask, int64_t *left) {
    struct timespec none = {0, 0};
    *left = ns > 0 ? ns : 0;
    int found = REAL(ppoll)(handles, count, &none, mask);
    if (found)
        return found < 0 ? -errno : found;
    if (!ns) {
        now(); /* a program that looks again and again ends, too */
        return 0;
    }
    enum sleep kind = ns < 0 ? ABSOLUTE : RELATIVE;
    int error = wait_until(kind, (struct limit){ns < 0 ? NEVER : ns}, handles, count, mask, left);
    found = REAL(ppoll)(handles, count, &none, NULL);
    return found ? found : error;
}

static int64_t limit_of(const struct timespec *limit) { return limit ? ns_of(limit) : -1; }

int poll(struct pollfd *handles, nfds_t count, int ms) {
    int64_t left;
    return simulated ? failed(ready(handles, count, ms * 1000000LL, NULL, &left))
                     : REAL(poll)(handles, count, ms);
}

int ppoll(struct pollfd *handles, nfds_t count, const struct timespec *limit, const sigset_t *mask) {
    int64_t left;
    if (!simulated)
        return REAL(ppoll)(handles, count, limit, mask);
    return failed(ready(handles, count, limit_of(limit), mask, &left));
}

int __poll_chk(struct pollfd *handles, nfds_t count, int ms, size_t room) {
    (void)room;
    return poll(handles, count, ms);
}

int __ppoll_chk(struct pollfd *handles, nfds_t count, const struct timespec *limit, const sigset_t *mask,
                size_t room) {
    (void)room;
    return ppoll(handles, count, limit, mask);
}

/* As poll: the three sets become events, and what is found becomes sets. */
static int chosen(int count, fd_set *sets[3], int64_t ns, const sigset_t *mask, int64_t *left) {
    static const short asked[] = {POLLIN, POLLOUT, POLLPRI};
    static const short told[] = {POLLIN | POLLHUP | POLLERR, POLLOUT | POLLERR, POLLPRI};
    if (count < 0 || count > FD_SETSIZE)
        return -EINVAL;
    struct pollfd handles[FD_SETSIZE];
    int used = 0, found = 0;
    for (int i = 0; i < count; i++) {
        short events = 0;
        for (int k = 0; k < 3; k++)
            events |= sets[k] && FD_ISSET(i, sets[k]) ? asked[k] : 0;
        if (events)
            handles[used++] = (struct pollfd){i, events, 0};
    }
    int result = ready(handles, used, ns, mask, left);
    for (int i = 0; i < used; i++)
        if (handles[i].revents & POLLNVAL)
            result = -EBADF;
    for (int i = 0; result >= 0 && i < used; i++)
        for (int k = 0; k < 3; k++) {
            if (!sets[k] || !FD_ISSET(handles[i].fd, sets[k]))
                continue;
            if (handles[i].revents & told[k])
                found++;
            else
                FD_CLR(handles[i].fd, sets[k]);
        }
    return result < 0 ? result : found;
}

int select(int count, fd_set *in, fd_set *out, fd_set *odd, struct timeval *limit) {
    int64_t left;
    if (!simulated)
        return REAL(select)(count, in, out, odd, limit);
    int result = chosen(count, (fd_set *[]){in, out, odd}, limit ? ns_of_us(limit) : -1, NULL, &left);
    if (limit)
        *limit = us_of(left > 0 ? left : 0);
    return failed(result);
}

int pselect(int count, fd_set *in, fd_set *out, fd_set *odd, const struct timespec *limit,
            const sigset_t *mask) {
    int64_t left;
    if (!simulated)
        return REAL(pselect)(count, in, out, odd, limit, mask);
    return failed(chosen(count, (fd_set *[]){in, out, odd}, limit_of(limit), mask, &left));
}

int epoll_pwait(int handle, struct epoll_event *found, int room, int ms, const sigset_t *mask) {
    struct pollfd own = {handle, POLLIN, 0};
    int64_t left;
    if (!simulated)
        return REAL(epoll_pwait)(handle, found, room, ms, mask);
    int result = ready(&own, 1, ms * 1000000LL, mask, &left);
    return result < 0 ? failed(result) : REAL(epoll_pwait)(handle, found, room, 0, NULL);
}

int epoll_wait(int handle, struct epoll_event *found, int room, int ms) {
    return simulated ? epoll_pwait(handle, found, room, ms, NULL) : REAL(epoll_wait)(handle, found, room, ms);
}

/* Timers ------------------------------------------------------------------------------------------------- */

/* A thread of this library sleeps until the first of them is due. */

enum use { FREE, ALARM, POSIX, HANDLE };

struct timer {
    enum use use;
    int64_t due, every; /* due 0: it does not run */
    struct sigevent event;
    int handle;
};

#define MOST_TIMERS 256
static struct timer timers[MOST_TIMERS]; /* the first is that of alarm and setitimer */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int changed = -1; /* an eventfd that wakes the thread */

static void hold(sigset_t *before) {
    sigset_t every;
    sigfillset(&every);
    pthread_sigmask(SIG_BLOCK, &every, before);
    REAL(pthread_mutex_lock)(&lock);
}

static void let_go(const sigset_t *before) {
    REAL(pthread_mutex_unlock)(&lock);
    pthread_sigmask(SIG_SETMASK, before, NULL);
}

/* In a child, which has none of its parent's timers. */
void forget_timers(void) {
    memset(timers, 0, sizeof timers);
    pthread_mutex_init(&lock, NULL);
    changed = -1;
}

struct call { void (*routine)(union sigval); union sigval value; };

static void *call_back(void *given) {
    struct call own = *(struct call *)given;
    sigset_t none;
    sigemptyset(&none);
    pthread_sigmask(SIG_SETMASK, &none, NULL);
    free(given);
    own.routine(own.value);
    return NULL;
}

static void tell(const struct sigevent *event) {
    if (event->sigev_notify == SIGEV_THREAD) {
        struct call *call = malloc(sizeof *call);
        pthread_t made;
        if (!call)
            return;
        *call = (struct call){event->sigev_notify_function, event->sigev_value};
        if (pthread_create(&made, event->sigev_notify_attributes, call_back, call))
            free(call);
        else
            pthread_detach(made);
        return;
    }
    siginfo_t info = {.si_signo = event->sigev_signo, .si_code = SI_TIMER};
    info.si_value = event->sigev_value;
    if (event->sigev_notify == SIGEV_SIGNAL)
        syscall(SYS_rt_sigqueueinfo, getpid(), info.si_signo, &info);
    else if (event->sigev_notify == SIGEV_THREAD_ID)
        syscall(SYS_rt_tgsigqueueinfo, getpid(), event->_sigev_un._tid, info.si_signo, &info);
}

static void fire(struct timer *timer) {
    uint64_t once = 1;
    timer->due = timer->every ? timer->due + timer->every : 0;
    if (timer->use == ALARM)
        kill(getpid(), SIGALRM);
    else if (timer->use == POSIX)
        tell(&timer->event);
    else if (timer->use == HANDLE && REAL(write)(timer->handle, &once, sizeof once) < 0)
        timer->use = FREE;
}

static int64_t fire_all(int64_t at) {
    int64_t first = NEVER;
    sigset_t before;
    hold(&before);
    for (int i = 0; i < MOST_TIMERS; i++) {
        while (timers[i].due && timers[i].due <= at)
            fire(&timers[i]);
        if (timers[i].due && timers[i].due < first)
            first = timers[i].due;
    }
    let_go(&before);
    return first;
}

static void *watch(void *given) {
    struct pollfd own = {changed, POLLIN, 0};
    int64_t first, left, at = 0;
    uint64_t count;
    (void)given;
    for (;;) {
        if ((first = fire_all(at)) == NEVER) {
            REAL(poll)(&own, 1, -1);
            first = 0; /* asks for the time */
        }
        wait_until(ABSOLUTE, (struct limit){first}, first ? &own : NULL, first ? 1 : 0, NULL, &left);
        at = first - left;
        if (REAL(poll)(&own, 1, 0) == 1 && REAL(read)(changed, &count, sizeof count) < 0)
            return NULL;
    }
}

/* The thread begins with the first timer. */
static void start_watch(void) {
    pthread_t made;
    pthread_attr_t how;
    if (changed >= 0)
        return;
    changed = out_of_the_way(eventfd(0, EFD_CLOEXEC));
    pthread_attr_init(&how);
    pthread_attr_setdetachstate(&how, PTHREAD_CREATE_DETACHED);
    pthread_create(&made, &how, watch, NULL); /* which has all signals blocked, as `hold` has */
    pthread_attr_destroy(&how);
}

/* Set a timer to a time; return how long it had to go, 0 where it did not run, and tell the interval. */
static int64_t set(struct timer *timer, int64_t at, int64_t due, int64_t every, int64_t *interval) {
    uint64_t once = 1;
    sigset_t before;
    hold(&before);
    int64_t left = timer->due ? (timer->due > at ? timer->due - at : 1) : 0;
    if (interval)
        *interval = timer->every;
    timer->due = due;
    timer->every = every;
    start_watch();
    if (REAL(write)(changed, &once, sizeof once) < 0)
        left = 0;
    let_go(&before);
    return left;
}

static int64_t left_of(struct timer *timer, int64_t *interval) {
    int64_t at = now();
    *interval = timer->every;
    return timer->due ? (timer->due > at ? timer->due - at : 1) : 0;
}

static struct timer *take(enum use use) {
    struct timer *found = NULL;
    sigset_t before;
    hold(&before);
    for (int i = 1; i < MOST_TIMERS && !found; i++)
        if (timers[i].use == FREE) {
            found = &timers[i];
            *found = (struct timer){.use = use};
        }
    let_go(&before);
    return found;
}

static void release(void *timer) {
    sigset_t before;
    hold(&before);
    *(struct timer *)timer = (struct timer){.use = FREE};
    let_go(&before);
}

static int64_t set_alarm(int64_t ns, int64_t every, int64_t *interval) {
    int64_t at = now();
    timers[0].use = ALARM;
    return set(&timers[0], at, ns ? at + ns : 0, every, interval);
}

unsigned int alarm(unsigned int seconds) {
    if (!simulated)
        return REAL(alarm)(seconds);
    int64_t left = set_alarm(seconds * BILLION, 0, NULL);
    return left && left < BILLION / 2 ? 1 : (left + BILLION / 2) / BILLION;
}

useconds_t ualarm(useconds_t us, useconds_t every) {
    return simulated ? set_alarm(us * 1000LL, every * 1000LL, NULL) / 1000 : REAL(ualarm)(us, every);
}

int getitimer(__itimer_which_t which, struct itimerval *found) {
    int64_t every;
    if (!simulated || which != ITIMER_REAL)
        return REAL(getitimer)(which, found);
    found->it_value = us_of(left_of(&timers[0], &every));
    found->it_interval = us_of(every);
    return 0;
}

int setitimer(__itimer_which_t which, const struct itimerval *wanted, struct itimerval *old) {
    int64_t every;
    if (!simulated || which != ITIMER_REAL)
        return REAL(setitimer)(which, wanted, old);
    int64_t left = set_alarm(ns_of_us(&wanted->it_value), ns_of_us(&wanted->it_interval), &every);
    if (old)
        *old = (struct itimerval){us_of(every), us_of(left)};
    return 0;
}

static int set_timer(struct timer *timer, int absolute, const struct itimerspec *wanted,
                     struct itimerspec *old) {
    int64_t every, at = now(), due = wanted->it_value.tv_sec || wanted->it_value.tv_nsec;
    if (wanted->it_value.tv_nsec >= BILLION || wanted->it_value.tv_sec < 0 || wanted->it_value.tv_nsec < 0)
        return failed(-EINVAL);
    if (due)
        due = absolute ? since_start(&wanted->it_value) : at + ns_of(&wanted->it_value);
    int64_t left = set(timer, at, due, ns_of(&wanted->it_interval), &every);
    if (old)
        *old = (struct itimerspec){time_of(every), time_of(left)};
    return 0;
}

static int get_timer(struct timer *timer, struct itimerspec *found) {
    int64_t every, left = left_of(timer, &every);
    *found = (struct itimerspec){time_of(every), time_of(left)};
    return 0;
}

/* The number of a timer is its place. */
static struct timer *posix(timer_t number) {
    uintptr_t place = (uintptr_t)number;
    return place && place < MOST_TIMERS && timers[place].use == POSIX ? &timers[place] : NULL;
}

int timer_create(clockid_t clock, struct sigevent *event, timer_t *made) {
    if (!simulated)
        return REAL(timer_create)(clock, event, made);
    struct timer *timer = take(POSIX);
    if (!timer)
        return failed(-EAGAIN);
    *made = (timer_t)(uintptr_t)(timer - timers);
    if (event)
        timer->event = *event;
    else
        timer->event = (struct sigevent){.sigev_signo = SIGALRM, .sigev_value = {.sival_ptr = *made}};
    return 0;
}

int timer_settime(timer_t number, int flags, const struct itimerspec *wanted, struct itimerspec *old) {
    if (!simulated)
        return REAL(timer_settime)(number, flags, wanted, old);
    struct timer *timer = posix(number);
    return timer ? set_timer(timer, flags & TIMER_ABSTIME, wanted, old) : failed(-EINVAL);
}

int timer_gettime(timer_t number, struct itimerspec *found) {
    if (!simulated)
        return REAL(timer_gettime)(number, found);
    return posix(number) ? get_timer(posix(number), found) : failed(-EINVAL);
}

int timer_getoverrun(timer_t number) {
    if (!simulated)
        return REAL(timer_getoverrun)(number);
    return posix(number) ? 0 : failed(-EINVAL);
}

int timer_delete(timer_t number) {
    if (!simulated)
        return REAL(timer_delete)(number);
    if (!posix(number))
        return failed(-EINVAL);
    release(posix(number));
    return 0;
}

/* A handle of a timer is an eventfd, whose reading gives a count as well. */
int timerfd_create(clockid_t clock, int flags) {
    if (!simulated)
        return REAL(timerfd_create)(clock, flags);
    struct timer *timer = take(HANDLE);
    int handle = timer ? eventfd(0, flags) : failed(-EMFILE);
    if (handle < 0 || handle >= MOST_HANDLES) {
        if (timer)
            release(timer);
        return handle < 0 ? -1 : (REAL(close)(handle), failed(-EMFILE));
    }
    timer->handle = handle;
    kinds[handle] = TIMER;
    return handle;
}

static struct timer *timer_of(int handle) {
    for (int i = 1; i < MOST_TIMERS; i++)
        if (timers[i].use == HANDLE && timers[i].handle == handle)
            return &timers[i];
    return NULL;
}

void forget_timer_of(int handle) {
    struct timer *timer = timer_of(handle);
    if (timer)
        release(timer);
}

int timerfd_settime(int handle, int flags, const struct itimerspec *wanted, struct itimerspec *old) {
    struct timer *timer = simulated ? timer_of(handle) : NULL;
    struct pollfd own = {handle, POLLIN, 0};
    uint64_t count;
    if (!timer)
        return REAL(timerfd_settime)(handle, flags, wanted, old);
    if (REAL(poll)(&own, 1, 0) == 1 && REAL(read)(handle, &count, sizeof count) < 0)
        return -1;
    return set_timer(timer, flags & TFD_TIMER_ABSTIME, wanted, old);
}

int timerfd_gettime(int handle, struct itimerspec *found) {
    struct timer *timer = simulated ? timer_of(handle) : NULL;
    return timer ? get_timer(timer, found) : REAL(timerfd_gettime)(handle, found);
}

/* Signals are looked for in steps. */
int sigtimedwait(const sigset_t *wanted, siginfo_t *found, const struct timespec *limit) {
    struct timespec none = {0, 0};
    int number;
    if (!simulated || !limit)
        return REAL(sigtimedwait)(wanted, found, limit);
    int64_t end = now() + ns_of(limit);
    while ((number = REAL(sigtimedwait)(wanted, found, &none)) < 0 && errno == EAGAIN)
        if (now() >= end)
            return failed(-EAGAIN);
        else
            wait_until(RELATIVE, (struct limit){BILLION / 1000}, NULL, 0, NULL, NULL);
    return number;
}

/* Times of 64 bits in programs of 32 --------------------------------------------------------------------- */

#if __WORDSIZE == 32

struct wide { int64_t seconds; int32_t rest, unused; };
struct wide_us { int64_t seconds, us; };
struct wide_timer { struct wide interval, value; };

static struct timespec narrow(const struct wide *time) {
    return (struct timespec){time->seconds, time->rest};
}
static struct wide widen(struct timespec time) { return (struct wide){time.tv_sec, time.tv_nsec, 0}; }

#define NARROW(given) ((given) ? &(struct timespec){(given)->seconds, (given)->rest} : NULL)

int __clock_gettime64(clockid_t clock, struct wide *time) {
    struct timespec found;
    int result = clock_gettime(clock, &found);
    *time = widen(found);
    return result;
}

int __gettimeofday64(struct wide_us *time, void *zone) {
    struct timeval found;
    int result = gettimeofday(&found, zone);
    *time = (struct wide_us){found.tv_sec, found.tv_usec};
    return result;
}

int64_t __time64(int64_t *place) {
    int64_t found = time(NULL);
    if (place)
        *place = found;
    return found;
}

int __clock_nanosleep_time64(clockid_t clock, int flags, const struct wide *wanted, struct wide *left) {
    struct timespec rest = {0, 0};
    int error = clock_nanosleep(clock, flags, NARROW(wanted), &rest);
    if (left && error == EINTR)
        *left = widen(rest);
    return error;
}

int __nanosleep64(const struct wide *wanted, struct wide *left) {
    return failed(-__clock_nanosleep_time64(CLOCK_REALTIME, 0, wanted, left));
}

int __ppoll64(struct pollfd *handles, nfds_t count, const struct wide *limit, const sigset_t *mask) {
    return ppoll(handles, count, NARROW(limit), mask);
}

int __pselect64(int count, fd_set *in, fd_set *out, fd_set *odd, const struct wide *limit,
                const sigset_t *mask) {
    return pselect(count, in, out, odd, NARROW(limit), mask);
}

int __select64(int count, fd_set *in, fd_set *out, fd_set *odd, struct wide_us *limit) {
    struct timeval own = {limit ? limit->seconds : 0, limit ? limit->us : 0};
    int result = select(count, in, out, odd, limit ? &own : NULL);
    if (limit)
        *limit = (struct wide_us){own.tv_sec, own.tv_usec};
    return result;
}

/* Timers, set or asked by one of the two functions that do. */
#define TIMER64(name, handle_type)                                                                           \
    int __##name##_settime64(handle_type handle, int flags, const struct wide_timer *wanted,                 \
                             struct wide_timer *old) {                                                       \
        struct itimerspec before, own = {narrow(&wanted->interval), narrow(&wanted->value)};                 \
        int result = name##_settime(handle, flags, &own, &before);                                           \
        if (old && !result)                                                                                  \
            *old = (struct wide_timer){widen(before.it_interval), widen(before.it_value)};                   \
        return result;                                                                                       \
    }                                                                                                        \
    int __##name##_gettime64(handle_type handle, struct wide_timer *found) {                                 \
        struct itimerspec own;                                                                               \
        int result = name##_gettime(handle, &own);                                                           \
        if (!result)                                                                                         \
            *found = (struct wide_timer){widen(own.it_interval), widen(own.it_value)};                       \
        return result;                                                                                       \
    }
TIMER64(timer, timer_t)
TIMER64(timerfd, int)

struct wide_interval { struct wide_us interval, value; };

int __setitimer64(__itimer_which_t which, const struct wide_interval *wanted, struct wide_interval *old) {
    struct itimerval before, own = {{wanted->interval.seconds, wanted->interval.us},
                                    {wanted->value.seconds, wanted->value.us}};
    int result = setitimer(which, &own, &before);
    if (old && !result)
        *old = (struct wide_interval){{before.it_interval.tv_sec, before.it_interval.tv_usec},
                                      {before.it_value.tv_sec, before.it_value.tv_usec}};
    return result;
}

int __getitimer64(__itimer_which_t which, struct wide_interval *found) {
    struct itimerval own;
    int result = getitimer(which, &own);
    *found = (struct wide_interval){{own.it_interval.tv_sec, own.it_interval.tv_usec},
                                    {own.it_value.tv_sec, own.it_value.tv_usec}};
    return result;
}

#endif
