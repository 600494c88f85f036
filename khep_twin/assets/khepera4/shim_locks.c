/* Waits of threads for each other, with a simulated clock: mutexes, conditions, semaphores.

   A thread that finds one taken waits at the twin for a wake of its place, which is its address; who gives it
   back wakes. So the twin decides who goes on, and that repeats, where the kernel's choice would not. */

#include "shim.h"

#include <fcntl.h>
#include <semaphore.h>
#include <stdarg.h>

#define STEP_NS 1000000 /* in which those look again whom another process can wake */
#define MOST_PLACES 1024

static struct place { int waiting; uint64_t wakes; } places[MOST_PLACES]; /* by a part of the address */
static int between_processes;

static struct place *place_of(const void *at) { return &places[(uintptr_t)at / 8 % MOST_PLACES]; }

/* In a child, which has none of its parent's threads. */
void forget_locks(void) {
    for (int i = 0; i < MOST_PLACES; i++)
        places[i].waiting = 0;
}

static void tell(const void *at, uint32_t count) {
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    if (place_of(at)->waiting)
        wake(count, (uintptr_t)at, __atomic_add_fetch(&place_of(at)->wakes, 1, __ATOMIC_SEQ_CST));
}

static uint64_t enlist(const void *at) {
    __atomic_add_fetch(&place_of(at)->waiting, 1, __ATOMIC_SEQ_CST);
    return __atomic_load_n(&place_of(at)->wakes, __ATOMIC_SEQ_CST);
}

static void strike(const void *at) { __atomic_sub_fetch(&place_of(at)->waiting, 1, __ATOMIC_SEQ_CST); }

/* Wait for a wake later than one seen: 0 when the time has passed, 1 after a wake, or minus EINTR. */
static int wait_for(const void *at, uint64_t seen, int64_t until) {
    struct limit limit = {until, (uintptr_t)at, seen};
    int64_t next = between_processes ? now() + STEP_NS : NEVER;
    if (next < until)
        limit.ns = next;
    int result = wait_until(ABSOLUTE, limit, NULL, 0, NULL, NULL);
    return result || limit.ns == until ? result : 1;
}

static int64_t end_of(const struct timespec *limit) { return limit ? since_start(limit) : NEVER; }

typedef int attempt(void *);

/* True if a wait goes on after a handler of a signal; which one ran is not known, so all have to say so. */
static int restarts(void) {
    struct sigaction action;
    for (int i = 1; i < NSIG; i++)
        if (!sigaction(i, NULL, &action) && action.sa_handler != SIG_DFL && action.sa_handler != SIG_IGN &&
            !(action.sa_flags & SA_RESTART))
            return 0;
    return 1;
}

/* Try until it is not busy; return an error number. */
static int get(attempt *attempt, void *at, const struct timespec *limit, int interruptible) {
    int error = attempt(at), result = 1;
    while (error == EBUSY && result) {
        if (limit && (limit->tv_nsec < 0 || limit->tv_nsec >= 1000000000))
            return EINVAL;
        uint64_t seen = enlist(at);
        if ((error = attempt(at)) == EBUSY) {
            result = wait_for(at, seen, end_of(limit));
            error = result == -EINTR && interruptible && !restarts() ? EINTR : attempt(at);
        }
        strike(at);
    }
    return error == EBUSY ? ETIMEDOUT : error;
}

static int try_mutex(void *at) { return pthread_mutex_trylock(at); }
static int try_read(void *at) { return pthread_rwlock_tryrdlock(at); }
static int try_write(void *at) { return pthread_rwlock_trywrlock(at); }
static int try_token(void *at) { return sem_trywait(at) ? (errno == EAGAIN ? EBUSY : errno) : 0; }

/* True if a thread would wait for itself, of which the mutex itself has to tell. */
static int own(const pthread_mutex_t *mutex) {
    return (mutex->__data.__kind & 3) == PTHREAD_MUTEX_ERRORCHECK && mutex->__data.__owner == gettid();
}

#define MUTEX pthread_mutex_t *mutex
#define BOTH pthread_rwlock_t *both
#define TOKENS sem_t *tokens
#define LIMIT const struct timespec *limit
#define CLOCK clockid_t clock

int pthread_mutex_lock(MUTEX) {
    return simulated && !own(mutex) ? get(try_mutex, mutex, NULL, 0) : REAL(pthread_mutex_lock)(mutex);
}
int pthread_mutex_timedlock(MUTEX, LIMIT) {
    return simulated && !own(mutex) ? get(try_mutex, mutex, limit, 0)
                                    : REAL(pthread_mutex_timedlock)(mutex, limit);
}
int pthread_mutex_clocklock(MUTEX, CLOCK, LIMIT) {
    return simulated ? pthread_mutex_timedlock(mutex, limit)
                     : REAL(pthread_mutex_clocklock)(mutex, clock, limit);
}
int pthread_rwlock_rdlock(BOTH) {
    return simulated ? get(try_read, both, NULL, 0) : REAL(pthread_rwlock_rdlock)(both);
}
int pthread_rwlock_wrlock(BOTH) {
    return simulated ? get(try_write, both, NULL, 0) : REAL(pthread_rwlock_wrlock)(both);
}
int pthread_rwlock_timedrdlock(BOTH, LIMIT) {
    return simulated ? get(try_read, both, limit, 0) : REAL(pthread_rwlock_timedrdlock)(both, limit);
}
int pthread_rwlock_timedwrlock(BOTH, LIMIT) {
    return simulated ? get(try_write, both, limit, 0) : REAL(pthread_rwlock_timedwrlock)(both, limit);
}
int sem_wait(TOKENS) { return simulated ? failed(-get(try_token, tokens, NULL, 1)) : REAL(sem_wait)(tokens); }
int sem_timedwait(TOKENS, LIMIT) {
    return simulated ? failed(-get(try_token, tokens, limit, 1)) : REAL(sem_timedwait)(tokens, limit);
}
int sem_clockwait(TOKENS, CLOCK, LIMIT) {
    return simulated ? sem_timedwait(tokens, limit) : REAL(sem_clockwait)(tokens, clock, limit);
}

static int gave(const void *at, int result) {
    if (simulated && !result)
        tell(at, 0);
    return result;
}

int pthread_mutex_unlock(MUTEX) { return gave(mutex, REAL(pthread_mutex_unlock)(mutex)); }
int pthread_rwlock_unlock(BOTH) { return gave(both, REAL(pthread_rwlock_unlock)(both)); }
int sem_post(TOKENS) { return gave(tokens, REAL(sem_post)(tokens)); }

static void lock_again(void *mutex) { pthread_mutex_lock(mutex); }

static int wait_for_condition(pthread_cond_t *condition, MUTEX, LIMIT) {
    int result, error;
    if (limit && (limit->tv_nsec < 0 || limit->tv_nsec >= 1000000000))
        return EINVAL;
    uint64_t seen = enlist(condition);
    if ((error = pthread_mutex_unlock(mutex))) {
        strike(condition);
        return error;
    }
    pthread_cleanup_push(lock_again, mutex);
    result = wait_for(condition, seen, end_of(limit));
    strike(condition);
    pthread_cleanup_pop(0);
    error = pthread_mutex_lock(mutex);
    return error ? error : result ? 0 : ETIMEDOUT;
}

int pthread_cond_wait(pthread_cond_t *condition, MUTEX) {
    return simulated ? wait_for_condition(condition, mutex, NULL) : REAL(pthread_cond_wait)(condition, mutex);
}
int pthread_cond_timedwait(pthread_cond_t *condition, MUTEX, LIMIT) {
    return simulated ? wait_for_condition(condition, mutex, limit)
                     : REAL(pthread_cond_timedwait)(condition, mutex, limit);
}
int pthread_cond_clockwait(pthread_cond_t *condition, MUTEX, CLOCK, LIMIT) {
    return simulated ? wait_for_condition(condition, mutex, limit)
                     : REAL(pthread_cond_clockwait)(condition, mutex, clock, limit);
}
int pthread_cond_signal(pthread_cond_t *condition) {
    if (simulated)
        tell(condition, 1);
    return REAL(pthread_cond_signal)(condition);
}
int pthread_cond_broadcast(pthread_cond_t *condition) {
    if (simulated)
        tell(condition, 0);
    return REAL(pthread_cond_broadcast)(condition);
}

int pthread_barrier_wait(pthread_barrier_t *barrier) {
    int result = REAL(pthread_barrier_wait)(barrier);
    take_turn();
    return result;
}

/* A lock that processes share has an address in each, so their waits look again in steps. */
int sem_init(TOKENS, int shared, unsigned int value) {
    between_processes |= shared;
    return REAL(sem_init)(tokens, shared, value);
}
sem_t *sem_open(const char *name, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;
    unsigned int value = flags & O_CREAT ? va_arg(rest, unsigned int) : 0;
    va_end(rest);
    between_processes = 1;
    return REAL(sem_open)(name, flags, mode, value);
}
#define SHARED(what)                                                                                         \
    int pthread_##what##attr_setpshared(pthread_##what##attr_t *how, int shared) {                           \
        between_processes |= shared == PTHREAD_PROCESS_SHARED;                                               \
        return REAL(pthread_##what##attr_setpshared)(how, shared);                                           \
    }
SHARED(mutex)
SHARED(cond)
SHARED(rwlock)

#if __WORDSIZE == 32

struct wide { int64_t seconds; int32_t rest, unused; };

#define WIDE const struct wide *limit
#define NARROW &(struct timespec){limit->seconds, limit->rest}

int __pthread_cond_timedwait64(pthread_cond_t *condition, MUTEX, WIDE) {
    return pthread_cond_timedwait(condition, mutex, NARROW);
}
int __pthread_cond_clockwait64(pthread_cond_t *condition, MUTEX, CLOCK, WIDE) {
    return pthread_cond_clockwait(condition, mutex, clock, NARROW);
}
int __pthread_mutex_timedlock64(MUTEX, WIDE) { return pthread_mutex_timedlock(mutex, NARROW); }
int __sem_timedwait64(TOKENS, WIDE) { return sem_timedwait(tokens, NARROW); }

#endif
