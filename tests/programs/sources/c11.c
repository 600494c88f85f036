/* Waits of C11, of the kernel's futex, and others that have a time-out. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/futex.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/sem.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <threads.h>
#include <time.h>
#include <unistd.h>

static mtx_t mutex;
static cnd_t condition;
static uint32_t word;
static int ready;

static struct timespec after(double s) {
    struct timespec time;
    timespec_get(&time, TIME_UTC);
    int64_t ns = time.tv_nsec + (int64_t)(s * 1e9);
    return (struct timespec){time.tv_sec + ns / 1000000000, ns % 1000000000};
}

static double seconds(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec + time.tv_nsec * 1e-9;
}

static int wake(void *argument) {
    thrd_sleep(&(struct timespec){0, 200000000}, NULL);
    mtx_lock(&mutex);
    ready = 1;
    cnd_signal(&condition);
    mtx_unlock(&mutex);
    thrd_sleep(&(struct timespec){0, 200000000}, NULL);
    __atomic_store_n(&word, 1, __ATOMIC_SEQ_CST);
    syscall(SYS_futex, &word, FUTEX_WAKE | *(int *)argument, 1, NULL, NULL, 0);
    thrd_sleep(&(struct timespec){0, 500000000}, NULL);
    return 7;
}

static double start;
static void print(const char *name, int result) {
    printf("%s %d %.2f\n", name, result, seconds() - start);
    start = seconds();
}

int main(void) {
    thrd_t thread;
    struct timespec limit, duration = {0, 300000000};
    int private = FUTEX_PRIVATE_FLAG, result = 0, ends[2];
    char byte;
    start = seconds();
    print("thrd_sleep", thrd_sleep(&duration, NULL));
    mtx_init(&mutex, mtx_timed);
    cnd_init(&condition);
    mtx_lock(&mutex);
    limit = after(0.3);
    print("cnd_timedwait", cnd_timedwait(&condition, &mutex, &limit) == thrd_timedout);
    limit = after(0.3);
    print("mtx_timedlock", mtx_timedlock(&mutex, &limit) == thrd_timedout);
    thrd_create(&thread, wake, &private);
    while (!ready)
        cnd_wait(&condition, &mutex);
    mtx_unlock(&mutex);
    print("cnd_wait", ready);
    print("futex", syscall(SYS_futex, &word, FUTEX_WAIT | private, 0, NULL, NULL, 0));
    print("futex at once", syscall(SYS_futex, &word, FUTEX_WAIT, 0, NULL, NULL, 0) < 0 && errno == EAGAIN);
    print("futex in vain", syscall(SYS_futex, &word, FUTEX_WAIT, 1, &duration, NULL, 0) < 0 && errno == ETIMEDOUT);
    thrd_join(thread, &result);
    print("thrd_join", result);
    thrd_create(&thread, wake, &private);
    limit = after(0.4);
    print("timedjoin", pthread_timedjoin_np(thread, NULL, &limit) == ETIMEDOUT);
    int semaphore = semget(IPC_PRIVATE, 1, 0600);
    print("semtimedop", semtimedop(semaphore, &(struct sembuf){0, -1, 0}, 1, &duration) < 0 && errno == EAGAIN);
    semctl(semaphore, 0, IPC_RMID);
    socketpair(AF_UNIX, SOCK_STREAM, 0, ends);
    setsockopt(ends[0], SOL_SOCKET, SO_RCVTIMEO, &(struct timeval){0, 300000}, sizeof(struct timeval));
    print("recv", recv(ends[0], &byte, 1, 0) < 0 && errno == EAGAIN);
    print("read", read(ends[0], &byte, 1) < 0 && errno == EAGAIN);
    syscall(SYS_nanosleep, &duration, NULL);
    print("call", 0);
    return 0;
}
