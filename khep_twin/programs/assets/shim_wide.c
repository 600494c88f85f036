/* 64-bit times of programs of 32 bits. */

#include "shim.h"

#include <semaphore.h>
#include <sys/select.h>
#include <sys/timerfd.h>

#if __WORDSIZE == 32

struct wide_us { int64_t seconds, us; };
struct wide_timer { struct wide interval, value; };

static struct timespec narrow(const struct wide *time) {
    return (struct timespec){time->seconds, time->rest};
}
static struct wide widen(struct timespec time) { return (struct wide){time.tv_sec, time.tv_nsec, 0}; }

#define NARROW(time) ((time) ? &(struct timespec){(time)->seconds, (time)->rest} : NULL)

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

#define MUTEX pthread_mutex_t *mutex
#define WIDE const struct wide *limit

int __pthread_cond_timedwait64(pthread_cond_t *condition, MUTEX, WIDE) {
    return pthread_cond_timedwait(condition, mutex, NARROW(limit));
}
int __pthread_cond_clockwait64(pthread_cond_t *condition, MUTEX, clockid_t clock, WIDE) {
    return pthread_cond_clockwait(condition, mutex, clock, NARROW(limit));
}
int __pthread_mutex_timedlock64(MUTEX, WIDE) { return pthread_mutex_timedlock(mutex, NARROW(limit)); }
int __sem_timedwait64(sem_t *sem, WIDE) { return sem_timedwait(sem, NARROW(limit)); }

#endif
