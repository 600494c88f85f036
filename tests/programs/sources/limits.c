/* Waits for other threads and for handles with a limit. */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdio.h>
#include <string.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER, other = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t condition = PTHREAD_COND_INITIALIZER;
static sem_t tokens;
static int ends[2];
static double begun;

static double seconds(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec + time.tv_nsec / 1e9 - begun;
}

static void say(const char *name, int result) {
    printf("%s %d %.3f\n", name, result, seconds());
    begun = 0, begun = seconds();
}

static struct timespec in(clockid_t clock, int ms) {
    struct timespec time;
    clock_gettime(clock, &time);
    long long ns = time.tv_nsec + ms * 1000000LL;
    return (struct timespec){time.tv_sec + ns / 1000000000, ns % 1000000000};
}

static void *help(void *unused) {
    usleep(550000);
    pthread_mutex_lock(&mutex);
    pthread_cond_signal(&condition);
    pthread_mutex_unlock(&mutex);
    usleep(500000);
    sem_post(&tokens);
    usleep(500000);
    if (write(ends[1], "x", 1) != 1)
        return NULL;
    pthread_mutex_lock(&other);
    usleep(500000);
    pthread_mutex_unlock(&other);
    return unused;
}

int main(void) {
    pthread_t helper;
    struct timespec limit;
    struct pollfd own;
    fd_set set;
    if (pipe(ends))
        return 1;
    own = (struct pollfd){ends[0], POLLIN, 0};
    FD_ZERO(&set);
    FD_SET(ends[0], &set);
    sem_init(&tokens, 0, 0);
    say("begin", 0);
    limit = in(CLOCK_REALTIME, 250);
    pthread_mutex_lock(&mutex);
    say("condition in vain", pthread_cond_timedwait(&condition, &mutex, &limit) == ETIMEDOUT);
    limit = in(CLOCK_MONOTONIC, 250);
    say("and by the other clock",
        pthread_cond_clockwait(&condition, &mutex, CLOCK_MONOTONIC, &limit) == ETIMEDOUT);
    limit = in(CLOCK_REALTIME, 250);
    say("semaphore in vain", sem_timedwait(&tokens, &limit) < 0 && errno == ETIMEDOUT);
    say("select in vain", pselect(ends[0] + 1, &set, NULL, NULL, &(struct timespec){0, 250000000}, NULL));
    say("poll in vain", ppoll(&own, 1, &(struct timespec){0, 250000000}, NULL));
    pthread_create(&helper, NULL, help, NULL);
    limit = in(CLOCK_REALTIME, 2000);
    say("condition", pthread_cond_timedwait(&condition, &mutex, &limit));
    pthread_mutex_unlock(&mutex);
    limit = in(CLOCK_REALTIME, 2000);
    say("semaphore", sem_timedwait(&tokens, &limit));
    say("poll", poll(&own, 1, 2000));
    usleep(1000);
    limit = in(CLOCK_REALTIME, 100);
    say("mutex in vain", pthread_mutex_timedlock(&other, &limit) == ETIMEDOUT);
    limit = in(CLOCK_REALTIME, 2000);
    say("mutex", pthread_mutex_timedlock(&other, &limit));
    return 0;
}
