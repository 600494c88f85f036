/* Threads that wake each other, children of all kinds, and a spinner. */
#define _GNU_SOURCE
#include <pthread.h>
#include <semaphore.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

extern char **environ;
static sem_t first, second;
static volatile int flag;
static const char *self;

static void say(const char *name) {
    struct timespec time;
    char line[64];
    clock_gettime(CLOCK_MONOTONIC, &time);
    if (write(1, line,
              snprintf(line, sizeof line, "%s %ld.%03ld\n", name, (long)time.tv_sec,
                       time.tv_nsec / 1000000)) < 0)
        _exit(1);
}

static void *answer(void *given) {
    for (int i = 0; i < 5; i++) {
        sem_wait(&first);
        say("answer");
        sem_post(&second);
    }
    return given;
}

static void *raise_flag(void *given) {
    usleep(20000);
    flag = 1;
    return given;
}

int main(int count, char **words) {
    pthread_t thread;
    char command[512];
    int status;
    pid_t child;
    self = words[0];
    if (count > 1) {
        usleep(10000);
        say(words[1]);
        return 0;
    }
    pthread_create(&thread, NULL, answer, NULL);
    for (int i = 0; i < 5; i++) {
        sem_post(&first);
        say("ask");
        sem_wait(&second);
    }
    pthread_join(thread, NULL);
    snprintf(command, sizeof command, "%s system", self);
    status = system(command);
    say("after");
    posix_spawn(&child, self, NULL, NULL, (char *[]){words[0], "spawned", NULL}, environ);
    say("meanwhile");
    waitpid(child, &status, 0);
    if (!(child = vfork())) {
        execl(self, self, "vforked", NULL);
        _exit(1);
    }
    waitpid(child, &status, 0);
    snprintf(command, sizeof command, "%s opened", self);
    pclose(popen(command, "w"));
    say("end");
    pthread_create(&thread, NULL, raise_flag, NULL);
    while (!flag)
        ;
    puts("flag");
    return 0;
}
