/* Waits of threads for each other with a simulated clock: mutexes, conditions, semaphores, futexes.

   A thread that finds a lock taken waits at the twin for a WAKE of its futex address, that of the lock; the
   thread that releases it sends the WAKE. So the twin orders the waiters, and not the kernel: runs repeat. */

#include "shim.h"

#include <fcntl.h>
#include <limits.h>
#include <semaphore.h>
#include <stdarg.h>
#include <stdio.h>
#include <sys/syscall.h>
#include <threads.h>

#include <linux/futex.h>

#define RETRY_NS 1000000 /* period of retries if another process can release the lock */
#define N_FUTEXES 1024

static struct futex { int waiting; uint64_t wakes; } futexes[N_FUTEXES]; /* hashed by address */
static int has_shared_locks;

static struct futex *futex_of(const void *address) { return &futexes[(uintptr_t)address / 8 % N_FUTEXES]; }

/* Called in a child process, which does not have its parent's threads. */
void forget_locks(void) {
    for (int i = 0; i < N_FUTEXES; i++)
        futexes[i].waiting = 0;
}

void notify(const void *address, uint32_t count) {
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    if (futex_of(address)->waiting)
        wake(count, (uintptr_t)address, __atomic_add_fetch(&futex_of(address)->wakes, 1, __ATOMIC_SEQ_CST));
}

uint64_t add_waiter(const void *address) {
    __atomic_add_fetch(&futex_of(address)->waiting, 1, __ATOMIC_SEQ_CST);
    return __atomic_load_n(&futex_of(address)->wakes, __ATOMIC_SEQ_CST);
}

void remove_waiter(const void *address) {
    __atomic_sub_fetch(&futex_of(address)->waiting, 1, __ATOMIC_SEQ_CST);
}

/* Wait for a WAKE later than a known one; return 0 after the time-out, 1 after a WAKE, or minus EINTR. */
static int wait_futex(const void *address, uint64_t last_wake, int64_t stop_ns, int is_shared) {
    struct limit limit = {stop_ns, (uintptr_t)address, last_wake};
    int64_t retry_ns = is_shared ? now() + RETRY_NS : NEVER;
    if (retry_ns < stop_ns)
        limit.ns = retry_ns;
    int result = wait_until(ABSOLUTE, limit, NULL, 0, NULL, NULL);
    return result || limit.ns == stop_ns ? result : 1;
}

static int64_t end_ns(const struct timespec *limit) { return limit ? since_start(limit) : NEVER; }

typedef int try_function(void *);

/* True if all signal handlers have SA_RESTART, as it is unknown which one interrupted the wait. */
static int restarts(void) {
    struct sigaction action;
    for (int i = 1; i < NSIG; i++)
        if (!sigaction(i, NULL, &action) && action.sa_handler != SIG_DFL && action.sa_handler != SIG_IGN &&
            !(action.sa_flags & SA_RESTART))
            return 0;
    return 1;
}

/* Try until the lock is not busy; return an error number. */
static int acquire(try_function *try_lock, void *address, const struct timespec *limit, int interruptible) {
    int error = try_lock(address), result = 1;
    while (error == EBUSY && result) {
        if (limit && (limit->tv_nsec < 0 || limit->tv_nsec >= 1000000000))
            return EINVAL;
        uint64_t last_wake = add_waiter(address);
        if ((error = try_lock(address)) == EBUSY) {
            result = wait_futex(address, last_wake, end_ns(limit), has_shared_locks);
            error = result == -EINTR && interruptible && !restarts() ? EINTR : try_lock(address);
        }
        remove_waiter(address);
    }
    return error == EBUSY ? ETIMEDOUT : error;
}

static int try_mutex(void *address) { return pthread_mutex_trylock(address); }
static int try_read(void *address) { return pthread_rwlock_tryrdlock(address); }
static int try_write(void *address) { return pthread_rwlock_trywrlock(address); }
static int try_token(void *address) { return sem_trywait(address) ? (errno == EAGAIN ? EBUSY : errno) : 0; }

/* True for a self-deadlock that the mutex reports as an error. */
static int is_own(const pthread_mutex_t *mutex) {
    return (mutex->__data.__kind & 3) == PTHREAD_MUTEX_ERRORCHECK && mutex->__data.__owner == gettid();
}

#define MUTEX pthread_mutex_t *mutex
#define RWLOCK pthread_rwlock_t *rwlock
#define CONDITION pthread_cond_t *condition
#define SEM sem_t *sem
#define DEADLINE const struct timespec *limit
#define CLOCK clockid_t clock

int pthread_mutex_lock(MUTEX) {
    return simulated && !is_own(mutex) ? acquire(try_mutex, mutex, NULL, 0) : REAL(pthread_mutex_lock)(mutex);
}
int pthread_mutex_timedlock(MUTEX, DEADLINE) {
    return simulated && !is_own(mutex) ? acquire(try_mutex, mutex, limit, 0)
                                          : REAL(pthread_mutex_timedlock)(mutex, limit);
}
REPLACE(pthread_mutex_clocklock, (MUTEX, CLOCK, DEADLINE), (mutex, clock, limit),
        pthread_mutex_timedlock(mutex, limit))
REPLACE(pthread_rwlock_rdlock, (RWLOCK), (rwlock), acquire(try_read, rwlock, NULL, 0))
REPLACE(pthread_rwlock_wrlock, (RWLOCK), (rwlock), acquire(try_write, rwlock, NULL, 0))
REPLACE(pthread_rwlock_timedrdlock, (RWLOCK, DEADLINE), (rwlock, limit), acquire(try_read, rwlock, limit, 0))
REPLACE(pthread_rwlock_timedwrlock, (RWLOCK, DEADLINE), (rwlock, limit), acquire(try_write, rwlock, limit, 0))
REPLACE(pthread_rwlock_clockrdlock, (RWLOCK, CLOCK, DEADLINE), (rwlock, clock, limit),
        pthread_rwlock_timedrdlock(rwlock, limit))
REPLACE(pthread_rwlock_clockwrlock, (RWLOCK, CLOCK, DEADLINE), (rwlock, clock, limit),
        pthread_rwlock_timedwrlock(rwlock, limit))
REPLACE(sem_wait, (SEM), (sem), c_result(-acquire(try_token, sem, NULL, 1)))
REPLACE(sem_timedwait, (SEM, DEADLINE), (sem, limit), c_result(-acquire(try_token, sem, limit, 1)))
REPLACE(sem_clockwait, (SEM, CLOCK, DEADLINE), (sem, clock, limit), sem_timedwait(sem, limit))

static int released(const void *address, int result) {
    if (simulated && !result)
        notify(address, 0);
    return result;
}

int pthread_mutex_unlock(MUTEX) { return released(mutex, REAL(pthread_mutex_unlock)(mutex)); }
int pthread_rwlock_unlock(RWLOCK) { return released(rwlock, REAL(pthread_rwlock_unlock)(rwlock)); }
int sem_post(SEM) { return released(sem, REAL(sem_post)(sem)); }

static void relock(void *mutex) { pthread_mutex_lock(mutex); }

static int wait_for_condition(CONDITION, MUTEX, DEADLINE) {
    int result, error;
    if (limit && (limit->tv_nsec < 0 || limit->tv_nsec >= 1000000000))
        return EINVAL;
    uint64_t last_wake = add_waiter(condition);
    if ((error = pthread_mutex_unlock(mutex))) {
        remove_waiter(condition);
        return error;
    }
    pthread_cleanup_push(relock, mutex);
    result = wait_futex(condition, last_wake, end_ns(limit), has_shared_locks);
    remove_waiter(condition);
    pthread_cleanup_pop(0);
    error = pthread_mutex_lock(mutex);
    return error ? error : result ? 0 : ETIMEDOUT;
}

REPLACE(pthread_cond_wait, (CONDITION, MUTEX), (condition, mutex), wait_for_condition(condition, mutex, NULL))
REPLACE(pthread_cond_timedwait, (CONDITION, MUTEX, DEADLINE), (condition, mutex, limit),
        wait_for_condition(condition, mutex, limit))
REPLACE(pthread_cond_clockwait, (CONDITION, MUTEX, CLOCK, DEADLINE), (condition, mutex, clock, limit),
        wait_for_condition(condition, mutex, limit))
int pthread_cond_signal(CONDITION) {
    if (simulated)
        notify(condition, 1);
    return REAL(pthread_cond_signal)(condition);
}
int pthread_cond_broadcast(CONDITION) {
    if (simulated)
        notify(condition, 0);
    return REAL(pthread_cond_broadcast)(condition);
}

int pthread_barrier_wait(pthread_barrier_t *barrier) {
    int result = REAL(pthread_barrier_wait)(barrier);
    wait_turn();
    return result;
}

/* A lock shared by processes has another address in each, so its waiters retry periodically. */
int sem_init(SEM, int shared, unsigned int value) {
    has_shared_locks |= shared;
    return REAL(sem_init)(sem, shared, value);
}
sem_t *sem_open(const char *name, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;
    unsigned int value = flags & O_CREAT ? va_arg(rest, unsigned int) : 0;
    va_end(rest);
    has_shared_locks = 1;
    return REAL(sem_open)(name, flags, mode, value);
}
#define SHARED(type)                                                                                         \
    int pthread_##type##attr_setpshared(pthread_##type##attr_t *attributes, int shared) {                    \
        has_shared_locks |= shared == PTHREAD_PROCESS_SHARED;                                                \
        return REAL(pthread_##type##attr_setpshared)(attributes, shared);                                    \
    }
SHARED(mutex)
SHARED(cond)
SHARED(rwlock)

/* C11 threads: their objects are those of POSIX in the C library. */

static int c11_result(int error) {
    switch (error) {
    case 0:
        return thrd_success;
    case ETIMEDOUT:
        return thrd_timedout;
    case ENOMEM:
        return thrd_nomem;
    default:
        return error == EBUSY ? thrd_busy : thrd_error;
    }
}

#define MTX ((pthread_mutex_t *)mutex)
#define CND ((pthread_cond_t *)condition)

int mtx_lock(mtx_t *mutex) { return c11_result(pthread_mutex_lock(MTX)); }
int mtx_timedlock(mtx_t *mutex, DEADLINE) { return c11_result(pthread_mutex_timedlock(MTX, limit)); }
int mtx_unlock(mtx_t *mutex) { return c11_result(pthread_mutex_unlock(MTX)); }
int cnd_wait(cnd_t *condition, mtx_t *mutex) { return c11_result(pthread_cond_wait(CND, MTX)); }
int cnd_timedwait(cnd_t *condition, mtx_t *mutex, DEADLINE) {
    return c11_result(pthread_cond_timedwait(CND, MTX, limit));
}
int cnd_signal(cnd_t *condition) { return c11_result(pthread_cond_signal(CND)); }
int cnd_broadcast(cnd_t *condition) { return c11_result(pthread_cond_broadcast(CND)); }

struct c11_start { thrd_start_t routine; void *argument; };

static void *run_c11_thread(void *argument) {
    struct c11_start start = *(struct c11_start *)argument;
    free(argument);
    return (void *)(intptr_t)start.routine(start.argument);
}

int thrd_create(thrd_t *thread, thrd_start_t routine, void *argument) {
    struct c11_start *start = malloc(sizeof *start);
    if (!start)
        return thrd_nomem;
    *start = (struct c11_start){routine, argument};
    int error = pthread_create(thread, NULL, run_c11_thread, start);
    if (error)
        free(start);
    return error == EAGAIN ? thrd_nomem : c11_result(error);
}

/* Futexes, by `syscall` ---------------------------------------------------------------------------------- */

/* True if an address is in memory that processes share. */
static int is_shared_memory(const void *address) {
    FILE *file = fopen("/proc/self/maps", "re");
    char line[512], mode[5] = "";
    unsigned long start, end;
    int is_shared = 0;
    while (file && fgets(line, sizeof line, file))
        if (sscanf(line, "%lx-%lx %4s", &start, &end, mode) == 3 && (uintptr_t)address >= start &&
            (uintptr_t)address < end)
            is_shared = mode[3] == 's';
    if (file)
        fclose(file);
    return is_shared;
}

static long wait_word(uint32_t *word, int operation, uint32_t value, const struct timespec *limit) {
    struct timespec time;
    uint32_t current;
    int64_t stop_ns = NEVER;
    int is_shared = !(operation & FUTEX_PRIVATE_FLAG) && is_shared_memory(word);
    if (copy_memory(&current, word, sizeof current) || (limit && copy_memory(&time, limit, sizeof time)))
        return -1;
    if (limit && (time.tv_sec < 0 || time.tv_nsec < 0 || time.tv_nsec >= BILLION))
        return c_result(-EINVAL);
    if (limit) /* FUTEX_WAIT has a duration, FUTEX_WAIT_BITSET an end */
        stop_ns = (operation & FUTEX_CMD_MASK) == FUTEX_WAIT ? now() + ns_of(&time) : since_start(&time);
    uint64_t last_wake = add_waiter(word);
    int result = -EAGAIN;
    if (__atomic_load_n(word, __ATOMIC_SEQ_CST) == value) {
        result = wait_futex(word, last_wake, stop_ns, is_shared);
        result = result > 0 ? 0 : result ? result : -ETIMEDOUT;
    }
    remove_waiter(word);
    return c_result(result);
}

/* FUTEX_REQUEUE wakes all waiters, as a wait may end without a WAKE; others also run in the kernel. */
long call_futex(uint32_t *word, int operation, uint32_t value, const struct timespec *limit,
                uint32_t *other_word, uint32_t other_value) {
    int command = operation & FUTEX_CMD_MASK, n_waiting = futex_of(word)->waiting;
    if (command == FUTEX_WAIT || command == FUTEX_WAIT_BITSET)
        return wait_word(word, operation, value, limit);
    long result = REAL(syscall)(SYS_futex, word, operation, value, limit, other_word, other_value);
    if (result < 0 || command == FUTEX_FD || (command == FUTEX_WAKE && !value))
        return result;
    int is_wake = command == FUTEX_WAKE || command == FUTEX_WAKE_BITSET;
    notify(word, is_wake && value < INT_MAX ? value : 0);
    if (command == FUTEX_WAKE_OP)
        notify(other_word, 0);
    uint32_t n_woken = is_wake && value < (uint32_t)n_waiting ? value : (uint32_t)n_waiting;
    return result > (long)n_woken ? result : (long)n_woken;
}
