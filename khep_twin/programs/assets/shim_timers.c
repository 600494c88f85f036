/* Timers with a simulated clock: a thread of this library sleeps until the first is due. */

#include "shim.h"

#include <string.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>

enum use { FREE, ALARM, POSIX, DESCRIPTOR };

struct timer {
    enum use use;
    int64_t due, period; /* due 0: not set */
    struct sigevent event;
    struct private notifier; /* of a file descriptor */
    uint64_t peer, missed;   /* the program's end, and unread expirations */
};

#define MAX_TIMERS 256
static struct timer timers[MAX_TIMERS]; /* the first is for alarm and setitimer */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int thread_runs;

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
    thread_runs = 0;
}

static void free_timer(struct timer *timer) {
    if (is_open(timer->notifier))
        REAL(close)(timer->notifier.fd);
    *timer = (struct timer){.use = FREE};
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

static void send_event(const struct sigevent *event) {
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

/* Send expirations to the program's end; free the timer if that is closed. */
static void send_expirations(struct timer *timer) {
    timer->missed++;
    if (is_open(timer->notifier) &&
        send(timer->notifier.fd, &timer->missed, sizeof timer->missed, MSG_NOSIGNAL | MSG_DONTWAIT) >= 0)
        timer->missed = 0;
    else if (!is_open(timer->notifier) || errno != EAGAIN)
        free_timer(timer);
}

static void fire(struct timer *timer) {
    timer->due = timer->period ? timer->due + timer->period : 0;
    if (timer->use == ALARM)
        kill(getpid(), SIGALRM);
    else if (timer->use == POSIX)
        send_event(&timer->event);
    else if (timer->use == DESCRIPTOR)
        send_expirations(timer);
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
    int64_t left, now_ns = 0;
    for (;;) {
        uint64_t last_wake = add_waiter(timers);
        int64_t due = fire_all(now_ns);
        wait_until(ABSOLUTE, (struct limit){due, (uintptr_t)timers, last_wake}, NULL, 0, NULL, &left);
        remove_waiter(timers);
        now_ns = due - left;
    }
    return NULL;
}

/* Start the thread with the first timer. */
static void start_timers(void) {
    pthread_t thread;
    pthread_attr_t attributes;
    if (thread_runs)
        return;
    thread_runs = 1;
    pthread_attr_init(&attributes);
    pthread_attr_setdetachstate(&attributes, PTHREAD_CREATE_DETACHED);
    pthread_create(&thread, &attributes, run_timers, NULL); /* with the signals blocked by `lock_timers` */
    pthread_attr_destroy(&attributes);
}

/* Set the due time of a timer; return its previous remaining time, 0 if it was not set, and interval. */
static int64_t set_due(struct timer *timer, int64_t now_ns, int64_t due, int64_t period, int64_t *interval) {
    sigset_t saved;
    lock_timers(&saved);
    int64_t left = timer->due ? (timer->due > now_ns ? timer->due - now_ns : 1) : 0;
    if (interval)
        *interval = timer->period;
    timer->due = due;
    timer->period = period;
    start_timers();
    notify(timers, 0);
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
    for (int i = 1; i < MAX_TIMERS && !timer; i++) {
        struct pollfd peer = {timers[i].notifier.fd, 0, 0};
        if (timers[i].use == DESCRIPTOR &&
            (!is_open(timers[i].notifier) || (REAL(poll)(&peer, 1, 0) == 1 && peer.revents & POLLHUP)))
            free_timer(&timers[i]);
        if (timers[i].use == FREE) {
            timer = &timers[i];
            *timer = (struct timer){.use = use};
        }
    }
    unlock_timers(&saved);
    return timer;
}

static void release(struct timer *timer) {
    sigset_t saved;
    lock_timers(&saved);
    free_timer(timer);
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
    struct timeval left = us_of(remaining_ns(&timers[0], &period));
    return copy_memory(value, &(struct itimerval){us_of(period), left}, sizeof *value);
}

int setitimer(__itimer_which_t which, const struct itimerval *value, struct itimerval *old) {
    int64_t period;
    if (!simulated || which != ITIMER_REAL)
        return REAL(setitimer)(which, value, old);
    struct itimerval copy;
    if (copy_memory(&copy, value, sizeof copy))
        return -1;
    int64_t left = set_alarm(ns_of_us(&copy.it_value), ns_of_us(&copy.it_interval), &period);
    return old ? copy_memory(old, &(struct itimerval){us_of(period), us_of(left)}, sizeof *old) : 0;
}

static int set_timer(struct timer *timer, int absolute, const struct itimerspec *value,
                     struct itimerspec *old) {
    struct itimerspec copy;
    int64_t period, now_ns = now(), due;
    if (copy_memory(&copy, value, sizeof copy))
        return -1;
    due = copy.it_value.tv_sec || copy.it_value.tv_nsec;
    if (copy.it_value.tv_nsec >= BILLION || copy.it_value.tv_sec < 0 || copy.it_value.tv_nsec < 0)
        return c_result(-EINVAL);
    if (due)
        due = absolute ? since_start(&copy.it_value) : now_ns + ns_of(&copy.it_value);
    int64_t left = set_due(timer, now_ns, due, ns_of(&copy.it_interval), &period);
    return old ? copy_memory(old, &(struct itimerspec){time_of(period), time_of(left)}, sizeof *old) : 0;
}

static int get_timer(struct timer *timer, struct itimerspec *value) {
    int64_t period, left = remaining_ns(timer, &period);
    return copy_memory(value, &(struct itimerspec){time_of(period), time_of(left)}, sizeof *value);
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

REPLACE(timer_gettime, (timer_t number, struct itimerspec *value), (number, value),
        posix_timer(number) ? get_timer(posix_timer(number), value) : c_result(-EINVAL))
REPLACE(timer_getoverrun, (timer_t number), (number), posix_timer(number) ? 0 : c_result(-EINVAL))

int timer_delete(timer_t number) {
    if (!simulated)
        return REAL(timer_delete)(number);
    if (!posix_timer(number))
        return c_result(-EINVAL);
    release(posix_timer(number));
    return 0;
}

/* The file descriptor of a timer is a socket that receives numbers of expirations. Its other end, which this
   library holds, reports when the program has closed all copies of it. */
int timerfd_create(clockid_t clock, int flags) {
    int ends[2];
    if (!simulated)
        return REAL(timerfd_create)(clock, flags);
    if (socketpair(AF_UNIX, SOCK_STREAM | flags, 0, ends)) /* with equal flags */
        return -1;
    struct timer *timer = allocate(DESCRIPTOR);
    if (!timer) {
        REAL(close)(ends[0]);
        REAL(close)(ends[1]);
        return c_result(-EMFILE);
    }
    timer->notifier = protect(ends[1]);
    timer->peer = socket_inode(ends[0]);
    return ends[0];
}

static struct timer *timer_of(int fd) {
    uint64_t inode = 0;
    for (int i = 1; i < MAX_TIMERS; i++)
        if (timers[i].use == DESCRIPTOR) {
            if (!inode && !(inode = socket_inode(fd)))
                return NULL;
            if (timers[i].peer == inode)
                return &timers[i];
        }
    return NULL;
}

int is_timer(int fd) { return timer_of(fd) != NULL; }

/* Read the number of all expirations since the last read. */
ssize_t read_timer(int fd, void *content, size_t size) {
    uint64_t count = 0, more;
    struct pollfd poll_fd = {fd, POLLIN, 0};
    int blocks = !REAL(poll)(&poll_fd, 1, 0);
    if (size < sizeof count)
        return c_result(-EINVAL);
    if (REAL(read)(fd, &count, sizeof count) < 0)
        return -1;
    while (REAL(recv)(fd, &more, sizeof more, MSG_DONTWAIT) == sizeof more)
        count += more;
    if (blocks)
        wait_turn();
    return copy_memory(content, &count, sizeof count) ? -1 : (ssize_t)sizeof count;
}

int timerfd_settime(int fd, int flags, const struct itimerspec *value, struct itimerspec *old) {
    struct timer *timer = simulated ? timer_of(fd) : NULL;
    uint64_t count;
    if (!timer)
        return REAL(timerfd_settime)(fd, flags, value, old);
    while (REAL(recv)(fd, &count, sizeof count, MSG_DONTWAIT) > 0)
        ;
    timer->missed = 0;
    return set_timer(timer, flags & TFD_TIMER_ABSTIME, value, old);
}

int timerfd_gettime(int fd, struct itimerspec *value) {
    struct timer *timer = simulated ? timer_of(fd) : NULL;
    return timer ? get_timer(timer, value) : REAL(timerfd_gettime)(fd, value);
}
