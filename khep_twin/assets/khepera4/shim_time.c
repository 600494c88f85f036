/* The simulated clock of the preload library: functions that return the time, wait, or set a timer.

   Times are those of the twin [ns], from 0. CLOCK_REALTIME starts at `FIRST_DAY`, all other clocks at 0. */

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
    exchange(NOW, 0, NULL, 0, NULL, 0, &value);
    return value;
}

static int64_t to_ns(int64_t seconds, int64_t ns) {
    return seconds > NEVER / 2 / BILLION ? NEVER / 2 : seconds * BILLION + ns;
}
static int64_t ns_of(const struct timespec *time) { return to_ns(time->tv_sec, time->tv_nsec); }
static int64_t ns_of_us(const struct timeval *time) { return to_ns(time->tv_sec, time->tv_usec * 1000LL); }

/* Convert a time of any clock to the twin's: clocks that start at 0 never reach the first day. */
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

time_t time(time_t *result) {
    time_t seconds = simulated ? (now() + FIRST_DAY) / BILLION : REAL(time)(NULL);
    if (result)
        *result = seconds;
    return seconds;
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

/* Processor time is the elapsed time. */
clock_t clock(void) { return simulated ? now() / (BILLION / CLOCKS_PER_SEC) : REAL(clock)(); }

clock_t times(struct tms *result) {
    if (!simulated)
        return REAL(times)(result);
    clock_t ticks = now() / (BILLION / sysconf(_SC_CLK_TCK));
    if (result)
        *result = (struct tms){.tms_utime = ticks};
    return ticks;
}

/* Clocks cannot be set. */
int clock_settime(clockid_t clock, const struct timespec *time) {
    return simulated ? c_result(-EPERM) : REAL(clock_settime)(clock, time);
}
int settimeofday(const struct timeval *time, const struct timezone *zone) {
    return simulated ? c_result(-EPERM) : REAL(settimeofday)(time, zone);
}

/* Waits for a time --------------------------------------------------------------------------------------- */

int usleep(useconds_t us) {
    return simulated ? c_result(wait_until(RELATIVE, (struct limit){us * 1000LL}, NULL, 0, NULL, NULL))
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
static int sleep_for(enum sleep kind, const struct timespec *requested, struct timespec *left) {
    int64_t remaining = 0;
    if (requested->tv_sec < 0 || requested->tv_nsec < 0 || requested->tv_nsec >= BILLION)
        return EINVAL;
    struct limit limit = {kind == ABSOLUTE ? since_start(requested) : ns_of(requested)};
    int error = -wait_until(kind, limit, NULL, 0, NULL, &remaining);
    if (error && left && kind == RELATIVE)
        *left = time_of(remaining > 0 ? remaining : 0);
    return error;
}

int nanosleep(const struct timespec *requested, struct timespec *left) {
    return simulated ? c_result(-sleep_for(RELATIVE, requested, left)) : REAL(nanosleep)(requested, left);
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *requested, struct timespec *left) {
    if (!simulated)
        return REAL(clock_nanosleep)(clock, flags, requested, left);
    return sleep_for(flags & TIMER_ABSTIME ? ABSOLUTE : RELATIVE, requested, left);
}

/* Waits for file descriptors ----------------------------------------------------------------------------- */

/* Return the number of ready descriptors, or minus an error number; a time-out below 0 is none. */
static int poll_for(struct pollfd *fds, nfds_t count, int64_t ns, const sigset_t *mask, int64_t *left) {
    struct timespec no_wait = {0, 0};
    *left = ns > 0 ? ns : 0;
    int n_ready = REAL(ppoll)(fds, count, &no_wait, mask);
    if (n_ready)
        return n_ready < 0 ? -errno : n_ready;
    if (!ns) {
        now(); /* poll with time-out 0 takes time, so that a polling loop ends */
        return 0;
    }
    enum sleep kind = ns < 0 ? ABSOLUTE : RELATIVE;
    int error = wait_until(kind, (struct limit){ns < 0 ? NEVER : ns}, fds, count, mask, left);
    n_ready = REAL(ppoll)(fds, count, &no_wait, NULL);
    return n_ready ? n_ready : error;
}

static int64_t limit_of(const struct timespec *limit) { return limit ? ns_of(limit) : -1; }

int poll(struct pollfd *fds, nfds_t count, int ms) {
    int64_t left;
    return simulated ? c_result(poll_for(fds, count, ms * 1000000LL, NULL, &left))
                     : REAL(poll)(fds, count, ms);
}

int ppoll(struct pollfd *fds, nfds_t count, const struct timespec *limit, const sigset_t *mask) {
    int64_t left;
    if (!simulated)
        return REAL(ppoll)(fds, count, limit, mask);
    return c_result(poll_for(fds, count, limit_of(limit), mask, &left));
}

int __poll_chk(struct pollfd *fds, nfds_t count, int ms, size_t size) { return poll(fds, count, ms); }

int __ppoll_chk(struct pollfd *fds, nfds_t count, const struct timespec *limit, const sigset_t *mask,
                size_t size) {
    return ppoll(fds, count, limit, mask);
}

/* Select by poll: convert the three sets to events, and ready events back to sets. */
static int select_for(int count, fd_set *sets[3], int64_t ns, const sigset_t *mask, int64_t *left) {
    static const short requested_events[] = {POLLIN, POLLOUT, POLLPRI};
    static const short ready_events[] = {POLLIN | POLLHUP | POLLERR, POLLOUT | POLLERR, POLLPRI};
    if (count < 0 || count > FD_SETSIZE)
        return -EINVAL;
    struct pollfd fds[FD_SETSIZE];
    int n_fds = 0, n_ready = 0;
    for (int i = 0; i < count; i++) {
        short events = 0;
        for (int k = 0; k < 3; k++)
            events |= sets[k] && FD_ISSET(i, sets[k]) ? requested_events[k] : 0;
        if (events)
            fds[n_fds++] = (struct pollfd){i, events, 0};
    }
    int result = poll_for(fds, n_fds, ns, mask, left);
    for (int i = 0; i < n_fds; i++)
        if (fds[i].revents & POLLNVAL)
            result = -EBADF;
    for (int i = 0; result >= 0 && i < n_fds; i++)
        for (int k = 0; k < 3; k++) {
            if (!sets[k] || !FD_ISSET(fds[i].fd, sets[k]))
                continue;
            if (fds[i].revents & ready_events[k])
                n_ready++;
            else
                FD_CLR(fds[i].fd, sets[k]);
        }
    return result < 0 ? result : n_ready;
}

int select(int count, fd_set *in, fd_set *out, fd_set *odd, struct timeval *limit) {
    int64_t left;
    if (!simulated)
        return REAL(select)(count, in, out, odd, limit);
    int result = select_for(count, (fd_set *[]){in, out, odd}, limit ? ns_of_us(limit) : -1, NULL, &left);
    if (limit)
        *limit = us_of(left > 0 ? left : 0);
    return c_result(result);
}

int pselect(int count, fd_set *in, fd_set *out, fd_set *odd, const struct timespec *limit,
            const sigset_t *mask) {
    int64_t left;
    if (!simulated)
        return REAL(pselect)(count, in, out, odd, limit, mask);
    return c_result(select_for(count, (fd_set *[]){in, out, odd}, limit_of(limit), mask, &left));
}

int epoll_pwait(int fd, struct epoll_event *events, int size, int ms, const sigset_t *mask) {
    struct pollfd poll_fd = {fd, POLLIN, 0};
    int64_t left;
    if (!simulated)
        return REAL(epoll_pwait)(fd, events, size, ms, mask);
    int result = poll_for(&poll_fd, 1, ms * 1000000LL, mask, &left);
    return result < 0 ? c_result(result) : REAL(epoll_pwait)(fd, events, size, 0, NULL);
}

int epoll_wait(int fd, struct epoll_event *events, int size, int ms) {
    return simulated ? epoll_pwait(fd, events, size, ms, NULL) : REAL(epoll_wait)(fd, events, size, ms);
}

/* Timers ------------------------------------------------------------------------------------------------- */
/* A thread of this library sleeps until the first timer is due. */

enum use { FREE, ALARM, POSIX, DESCRIPTOR };

struct timer {
    enum use use;
    int64_t due, period; /* due 0: not set */
    struct sigevent event;
    int fd;
};

#define MAX_TIMERS 256
static struct timer timers[MAX_TIMERS]; /* the first is for alarm and setitimer */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int timers_changed = -1; /* eventfd that wakes the thread */

static void lock_timers(sigset_t *saved) {
    sigset_t signals;
    sigfillset(&signals);
    pthread_sigmask(SIG_BLOCK, &signals, saved);
    REAL(pthread_mutex_lock)(&lock);
}

static void unlock_timers(const sigset_t *saved) {
    REAL(pthread_mutex_unlock)(&lock);
    pthread_sigmask(SIG_SETMASK, saved, NULL);
}

/* Called in a child process, which does not have its parent's timers. */
void forget_timers(void) {
    memset(timers, 0, sizeof timers);
    pthread_mutex_init(&lock, NULL);
    timers_changed = -1;
}

struct call { void (*routine)(union sigval); union sigval value; };

static void *run_call(void *argument) {
    struct call call = *(struct call *)argument;
    sigset_t no_signals;
    sigemptyset(&no_signals);
    pthread_sigmask(SIG_SETMASK, &no_signals, NULL);
    free(argument);
    call.routine(call.value);
    return NULL;
}

static void notify(const struct sigevent *event) {
    if (event->sigev_notify == SIGEV_THREAD) {
        struct call *call = malloc(sizeof *call);
        pthread_t thread;
        if (!call)
            return;
        *call = (struct call){event->sigev_notify_function, event->sigev_value};
        if (pthread_create(&thread, event->sigev_notify_attributes, run_call, call))
            free(call);
        else
            pthread_detach(thread);
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
    timer->due = timer->period ? timer->due + timer->period : 0;
    if (timer->use == ALARM)
        kill(getpid(), SIGALRM);
    else if (timer->use == POSIX)
        notify(&timer->event);
    else if (timer->use == DESCRIPTOR && REAL(write)(timer->fd, &once, sizeof once) < 0)
        timer->use = FREE;
}

static int64_t fire_all(int64_t now_ns) {
    int64_t due = NEVER;
    sigset_t saved;
    lock_timers(&saved);
    for (int i = 0; i < MAX_TIMERS; i++) {
        while (timers[i].due && timers[i].due <= now_ns)
            fire(&timers[i]);
        if (timers[i].due && timers[i].due < due)
            due = timers[i].due;
    }
    unlock_timers(&saved);
    return due;
}

static void *run_timers(void *unused) {
    struct pollfd poll_fd = {timers_changed, POLLIN, 0};
    int64_t due, left, now_ns = 0;
    uint64_t count;
    for (;;) {
        if ((due = fire_all(now_ns)) == NEVER) {
            REAL(poll)(&poll_fd, 1, -1);
            due = 0; /* a wait until 0 returns the time */
        }
        wait_until(ABSOLUTE, (struct limit){due}, due ? &poll_fd : NULL, due ? 1 : 0, NULL, &left);
        now_ns = due - left;
        if (REAL(poll)(&poll_fd, 1, 0) == 1 && REAL(read)(timers_changed, &count, sizeof count) < 0)
            return NULL;
    }
}

/* Start the thread with the first timer. */
static void start_timers(void) {
    pthread_t thread;
    pthread_attr_t attributes;
    if (timers_changed >= 0)
        return;
    timers_changed = move_fd(eventfd(0, EFD_CLOEXEC));
    pthread_attr_init(&attributes);
    pthread_attr_setdetachstate(&attributes, PTHREAD_CREATE_DETACHED);
    pthread_create(&thread, &attributes, run_timers, NULL); /* with the signals blocked by `lock_timers` */
    pthread_attr_destroy(&attributes);
}

/* Set the due time of a timer; return its previous remaining time, 0 if it was not set, and interval. */
static int64_t set_due(struct timer *timer, int64_t now_ns, int64_t due, int64_t period, int64_t *interval) {
    uint64_t once = 1;
    sigset_t saved;
    lock_timers(&saved);
    int64_t left = timer->due ? (timer->due > now_ns ? timer->due - now_ns : 1) : 0;
    if (interval)
        *interval = timer->period;
    timer->due = due;
    timer->period = period;
    start_timers();
    if (REAL(write)(timers_changed, &once, sizeof once) < 0)
        left = 0;
    unlock_timers(&saved);
    return left;
}

static int64_t remaining_ns(struct timer *timer, int64_t *interval) {
    int64_t now_ns = now();
    *interval = timer->period;
    return timer->due ? (timer->due > now_ns ? timer->due - now_ns : 1) : 0;
}

static struct timer *allocate(enum use use) {
    struct timer *timer = NULL;
    sigset_t saved;
    lock_timers(&saved);
    for (int i = 1; i < MAX_TIMERS && !timer; i++)
        if (timers[i].use == FREE) {
            timer = &timers[i];
            *timer = (struct timer){.use = use};
        }
    unlock_timers(&saved);
    return timer;
}

static void release(void *timer) {
    sigset_t saved;
    lock_timers(&saved);
    *(struct timer *)timer = (struct timer){.use = FREE};
    unlock_timers(&saved);
}

static int64_t set_alarm(int64_t ns, int64_t period, int64_t *interval) {
    int64_t now_ns = now();
    timers[0].use = ALARM;
    return set_due(&timers[0], now_ns, ns ? now_ns + ns : 0, period, interval);
}

unsigned int alarm(unsigned int seconds) {
    if (!simulated)
        return REAL(alarm)(seconds);
    int64_t left = set_alarm(seconds * BILLION, 0, NULL);
    return left && left < BILLION / 2 ? 1 : (left + BILLION / 2) / BILLION;
}

useconds_t ualarm(useconds_t us, useconds_t period) {
    return simulated ? set_alarm(us * 1000LL, period * 1000LL, NULL) / 1000 : REAL(ualarm)(us, period);
}

int getitimer(__itimer_which_t which, struct itimerval *value) {
    int64_t period;
    if (!simulated || which != ITIMER_REAL)
        return REAL(getitimer)(which, value);
    value->it_value = us_of(remaining_ns(&timers[0], &period));
    value->it_interval = us_of(period);
    return 0;
}

int setitimer(__itimer_which_t which, const struct itimerval *value, struct itimerval *old) {
    int64_t period;
    if (!simulated || which != ITIMER_REAL)
        return REAL(setitimer)(which, value, old);
    int64_t left = set_alarm(ns_of_us(&value->it_value), ns_of_us(&value->it_interval), &period);
    if (old)
        *old = (struct itimerval){us_of(period), us_of(left)};
    return 0;
}

static int set_timer(struct timer *timer, int absolute, const struct itimerspec *value,
                     struct itimerspec *old) {
    int64_t period, now_ns = now(), due = value->it_value.tv_sec || value->it_value.tv_nsec;
    if (value->it_value.tv_nsec >= BILLION || value->it_value.tv_sec < 0 || value->it_value.tv_nsec < 0)
        return c_result(-EINVAL);
    if (due)
        due = absolute ? since_start(&value->it_value) : now_ns + ns_of(&value->it_value);
    int64_t left = set_due(timer, now_ns, due, ns_of(&value->it_interval), &period);
    if (old)
        *old = (struct itimerspec){time_of(period), time_of(left)};
    return 0;
}

static int get_timer(struct timer *timer, struct itimerspec *value) {
    int64_t period, left = remaining_ns(timer, &period);
    *value = (struct itimerspec){time_of(period), time_of(left)};
    return 0;
}

/* The number of a timer is its index. */
static struct timer *posix_timer(timer_t number) {
    uintptr_t index = (uintptr_t)number;
    return index && index < MAX_TIMERS && timers[index].use == POSIX ? &timers[index] : NULL;
}

int timer_create(clockid_t clock, struct sigevent *event, timer_t *number) {
    if (!simulated)
        return REAL(timer_create)(clock, event, number);
    struct timer *timer = allocate(POSIX);
    if (!timer)
        return c_result(-EAGAIN);
    *number = (timer_t)(uintptr_t)(timer - timers);
    if (event)
        timer->event = *event;
    else
        timer->event = (struct sigevent){.sigev_signo = SIGALRM, .sigev_value = {.sival_ptr = *number}};
    return 0;
}

int timer_settime(timer_t number, int flags, const struct itimerspec *value, struct itimerspec *old) {
    if (!simulated)
        return REAL(timer_settime)(number, flags, value, old);
    struct timer *timer = posix_timer(number);
    return timer ? set_timer(timer, flags & TIMER_ABSTIME, value, old) : c_result(-EINVAL);
}

int timer_gettime(timer_t number, struct itimerspec *value) {
    if (!simulated)
        return REAL(timer_gettime)(number, value);
    return posix_timer(number) ? get_timer(posix_timer(number), value) : c_result(-EINVAL);
}

int timer_getoverrun(timer_t number) {
    if (!simulated)
        return REAL(timer_getoverrun)(number);
    return posix_timer(number) ? 0 : c_result(-EINVAL);
}

int timer_delete(timer_t number) {
    if (!simulated)
        return REAL(timer_delete)(number);
    if (!posix_timer(number))
        return c_result(-EINVAL);
    release(posix_timer(number));
    return 0;
}

/* A timer's file descriptor is an eventfd, which also reads as a count. */
int timerfd_create(clockid_t clock, int flags) {
    if (!simulated)
        return REAL(timerfd_create)(clock, flags);
    struct timer *timer = allocate(DESCRIPTOR);
    int fd = timer ? eventfd(0, flags) : c_result(-EMFILE);
    if (fd < 0 || fd >= MAX_FDS) {
        if (timer)
            release(timer);
        return fd < 0 ? -1 : (REAL(close)(fd), c_result(-EMFILE));
    }
    timer->fd = fd;
    kinds[fd] = TIMER;
    return fd;
}

static struct timer *timer_of(int fd) {
    for (int i = 1; i < MAX_TIMERS; i++)
        if (timers[i].use == DESCRIPTOR && timers[i].fd == fd)
            return &timers[i];
    return NULL;
}

void forget_timer_of(int fd) {
    struct timer *timer = timer_of(fd);
    if (timer)
        release(timer);
}

int timerfd_settime(int fd, int flags, const struct itimerspec *value, struct itimerspec *old) {
    struct timer *timer = simulated ? timer_of(fd) : NULL;
    struct pollfd poll_fd = {fd, POLLIN, 0};
    uint64_t count;
    if (!timer)
        return REAL(timerfd_settime)(fd, flags, value, old);
    if (REAL(poll)(&poll_fd, 1, 0) == 1 && REAL(read)(fd, &count, sizeof count) < 0)
        return -1;
    return set_timer(timer, flags & TFD_TIMER_ABSTIME, value, old);
}

int timerfd_gettime(int fd, struct itimerspec *value) {
    struct timer *timer = simulated ? timer_of(fd) : NULL;
    return timer ? get_timer(timer, value) : REAL(timerfd_gettime)(fd, value);
}

/* Poll for signals. */
int sigtimedwait(const sigset_t *signals, siginfo_t *info, const struct timespec *limit) {
    struct timespec no_wait = {0, 0};
    int number;
    if (!simulated || !limit)
        return REAL(sigtimedwait)(signals, info, limit);
    int64_t end = now() + ns_of(limit);
    while ((number = REAL(sigtimedwait)(signals, info, &no_wait)) < 0 && errno == EAGAIN)
        if (now() >= end)
            return c_result(-EAGAIN);
        else
            wait_until(RELATIVE, (struct limit){BILLION / 1000}, NULL, 0, NULL, NULL);
    return number;
}

/* Times of 64 bits in programs of 32 --------------------------------------------------------------------- */

#if __WORDSIZE == 32

struct wide_us { int64_t seconds, us; };
struct wide_timer { struct wide interval, value; };

static struct timespec narrow(const struct wide *time) {
    return (struct timespec){time->seconds, time->rest};
}
static struct wide widen(struct timespec time) { return (struct wide){time.tv_sec, time.tv_nsec, 0}; }

#define NARROW(given) ((given) ? &(struct timespec){(given)->seconds, (given)->rest} : NULL)

int __clock_gettime64(clockid_t clock, struct wide *time) {
    struct timespec narrow_time;
    int result = clock_gettime(clock, &narrow_time);
    *time = widen(narrow_time);
    return result;
}

int __gettimeofday64(struct wide_us *time, void *zone) {
    struct timeval narrow_time;
    int result = gettimeofday(&narrow_time, zone);
    *time = (struct wide_us){narrow_time.tv_sec, narrow_time.tv_usec};
    return result;
}

int64_t __time64(int64_t *result) {
    int64_t seconds = time(NULL);
    if (result)
        *result = seconds;
    return seconds;
}

int __clock_nanosleep_time64(clockid_t clock, int flags, const struct wide *requested, struct wide *left) {
    struct timespec remaining = {0, 0};
    int error = clock_nanosleep(clock, flags, NARROW(requested), &remaining);
    if (left && error == EINTR)
        *left = widen(remaining);
    return error;
}

int __nanosleep64(const struct wide *requested, struct wide *left) {
    return c_result(-__clock_nanosleep_time64(CLOCK_REALTIME, 0, requested, left));
}

int __ppoll64(struct pollfd *fds, nfds_t count, const struct wide *limit, const sigset_t *mask) {
    return ppoll(fds, count, NARROW(limit), mask);
}

int __pselect64(int count, fd_set *in, fd_set *out, fd_set *odd, const struct wide *limit,
                const sigset_t *mask) {
    return pselect(count, in, out, odd, NARROW(limit), mask);
}

int __select64(int count, fd_set *in, fd_set *out, fd_set *odd, struct wide_us *limit) {
    struct timeval narrow_limit = {limit ? limit->seconds : 0, limit ? limit->us : 0};
    int result = select(count, in, out, odd, limit ? &narrow_limit : NULL);
    if (limit)
        *limit = (struct wide_us){narrow_limit.tv_sec, narrow_limit.tv_usec};
    return result;
}

/* Set and get functions of both kinds of timers. */
#define TIMER64(name, id_type)                                                                               \
    int __##name##_settime64(id_type fd, int flags, const struct wide_timer *value,                          \
                             struct wide_timer *old) {                                                       \
        struct itimerspec old_value, narrow_value = {narrow(&value->interval), narrow(&value->value)};       \
        int result = name##_settime(fd, flags, &narrow_value, &old_value);                                   \
        if (old && !result)                                                                                  \
            *old = (struct wide_timer){widen(old_value.it_interval), widen(old_value.it_value)};             \
        return result;                                                                                       \
    }                                                                                                        \
    int __##name##_gettime64(id_type fd, struct wide_timer *value) {                                         \
        struct itimerspec narrow_value;                                                                      \
        int result = name##_gettime(fd, &narrow_value);                                                      \
        if (!result)                                                                                         \
            *value = (struct wide_timer){widen(narrow_value.it_interval), widen(narrow_value.it_value)};     \
        return result;                                                                                       \
    }
TIMER64(timer, timer_t)
TIMER64(timerfd, int)

struct wide_interval { struct wide_us interval, value; };

int __setitimer64(__itimer_which_t which, const struct wide_interval *value, struct wide_interval *old) {
    struct itimerval old_value, narrow_value = {{value->interval.seconds, value->interval.us},
                                    {value->value.seconds, value->value.us}};
    int result = setitimer(which, &narrow_value, &old_value);
    if (old && !result)
        *old = (struct wide_interval){{old_value.it_interval.tv_sec, old_value.it_interval.tv_usec},
                                      {old_value.it_value.tv_sec, old_value.it_value.tv_usec}};
    return result;
}

int __getitimer64(__itimer_which_t which, struct wide_interval *value) {
    struct itimerval narrow_value;
    int result = getitimer(which, &narrow_value);
    *value = (struct wide_interval){{narrow_value.it_interval.tv_sec, narrow_value.it_interval.tv_usec},
                                    {narrow_value.it_value.tv_sec, narrow_value.it_value.tv_usec}};
    return result;
}

#endif
