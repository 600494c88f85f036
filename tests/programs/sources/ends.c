/* Ends: by a jump out of a handler, of all handles, of a child that outlives its parent, by a signal. */
#define _GNU_SOURCE
#include <setjmp.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

static sigjmp_buf place;

static void jump(int signal) {
    (void)signal;
    siglongjmp(place, 1);
}

static void stop(int signal) {
    usleep(1000);
    _exit(signal + 100);
}

int main(int count, char **words) {
    const char *how = count > 1 ? words[1] : "";
    if (!strcmp(how, "jump")) {
        struct sigaction action = {.sa_handler = jump};
        sigaction(SIGALRM, &action, NULL);
        for (volatile int i = 0; i < 30; i++)
            if (!sigsetjmp(place, 1)) {
                ualarm(1000, 0);
                sleep(10);
                puts("slept");
            }
        puts("jumped");
    } else if (!strcmp(how, "close")) {
        for (int i = 3; i < 5000; i++)
            close(i);
        close_range(3, ~0u, 0);
        usleep(1000);
        puts("closed");
    } else if (!strcmp(how, "outlive")) {
        if (!fork())
            for (;;)
                usleep(1000);
        usleep(5000);
        return 4;
    } else if (!strcmp(how, "stop")) {
        signal(SIGINT, stop);
        signal(SIGTERM, stop);
        if (write(1, "up\n", 3) == 3)
            for (;;)
                usleep(10000);
    } else if (!strcmp(how, "long")) {
        sleep(4000000);
    } else {
        for (int i = 0; i < 3; i++)
            if (!fork())
                for (;;)
                    usleep(100);
        usleep(2000);
        kill(getpid(), SIGKILL);
    }
    return 0;
}
