/* Threads that wait beside each other, a main thread that waits for them, then a child. */
#include <pthread.h>
#include <stdio.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static void say(const char *name, int number) {
    struct timespec time;
    char line[64];
    clock_gettime(CLOCK_MONOTONIC, &time);
    int count = snprintf(line, sizeof line, "%s %d %ld.%06ld\n", name, number, (long)time.tv_sec, time.tv_nsec / 1000);
    if (write(1, line, count) != count)
        _exit(1);
}

static void *wait_on(void *given) {
    long us = (long)given;
    for (int i = 0; i < 5; i++) {
        usleep(us);
        say(us > 30000 ? "slow" : "fast", i);
    }
    return NULL;
}

int main(void) {
    pthread_t fast, slow;
    int status;
    pthread_create(&fast, NULL, wait_on, (void *)20000L);
    pthread_create(&slow, NULL, wait_on, (void *)50000L);
    pthread_join(fast, NULL);
    pthread_join(slow, NULL);
    say("main", 0);
    if (!fork()) {
        usleep(100000);
        say("child", 0);
        _exit(7);
    }
    wait(&status);
    say("parent", WEXITSTATUS(status));
    return 0;
}
