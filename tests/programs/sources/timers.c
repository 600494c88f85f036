/* Timers of all kinds, what they interrupt, and handles of timers. */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

static volatile int came, number;
static double begun;

static double seconds(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec + time.tv_nsec / 1e9 - begun;
}

static void begin(void) { begun = 0, begun = seconds(); }
static void say(const char *name) { printf("%s %.3f\n", name, seconds()); }

static void say_count(int handle) {
    uint64_t count = 0;
    ssize_t size = read(handle, &count, sizeof count);
    printf("read %zd, %d", size, (int)count);
    say(" at");
}

static void handle(int signal, siginfo_t *info, void *context) {
    (void)context;
    came++;
    number = info->si_code == SI_TIMER ? info->si_value.sival_int : -signal;
    seconds(); /* while the main thread sleeps */
}

static void call(union sigval value) { printf("called %d %.3f\n", value.sival_int, seconds()); }

int main(void) {
    struct sigaction action = {.sa_sigaction = handle, .sa_flags = SA_SIGINFO | SA_RESTART};
    struct timespec second = {1, 0}, left;
    sigaction(SIGALRM, &action, NULL);
    sigaction(SIGUSR1, &action, NULL);

    begin();
    alarm(2);
    pause();
    say("pause");
    begin();
    alarm(2);
    printf("sleep leaves %u", sleep(5));
    say(" at");
    setitimer(ITIMER_REAL, &(struct itimerval){{0, 0}, {0, 300000}}, NULL);
    printf("nanosleep %d %d", nanosleep(&second, &left), errno == EINTR);
    printf(" leaves %.3f\n", left.tv_sec + left.tv_nsec / 1e9);

    begin();
    came = 0;
    setitimer(ITIMER_REAL, &(struct itimerval){{0, 100000}, {0, 100000}}, NULL);
    while (came < 5)
        pause();
    say("interval 5");
    setitimer(ITIMER_REAL, &(struct itimerval){{0, 0}, {0, 0}}, NULL);

    timer_t timer;
    struct itimerspec every = {{0, 20000000}, {0, 50000000}}, once = {{0, 0}, {0, 70000000}}, found;
    struct sigevent event = {
        .sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGUSR1, .sigev_value.sival_int = 77};
    timer_create(CLOCK_MONOTONIC, &event, &timer);
    begin();
    timer_settime(timer, 0, &every, NULL);
    for (came = 0; came < 3;)
        pause();
    say("timer 3");
    timer_gettime(timer, &found);
    printf("value %d, next in %.3f\n", number, found.it_value.tv_nsec / 1e9);
    timer_delete(timer);

    event = (struct sigevent){
        .sigev_notify = SIGEV_THREAD, .sigev_notify_function = call, .sigev_value.sival_int = 5};
    timer_create(CLOCK_REALTIME, &event, &timer);
    begin();
    timer_settime(timer, 0, &once, NULL);
    usleep(200000);
    say("after");
    timer_delete(timer);

    int handle = timerfd_create(CLOCK_MONOTONIC, 0), all = epoll_create1(0);
    fd_set set;
    FD_ZERO(&set);
    FD_SET(handle, &set);
    begin();
    timerfd_settime(handle, 0, &every, NULL);
    say_count(handle);
    printf("select %d", select(handle + 1, &set, NULL, NULL, &(struct timeval){1, 0}));
    say(" at");
    usleep(50000);
    say_count(handle);
    epoll_ctl(all, EPOLL_CTL_ADD, handle, &(struct epoll_event){.events = EPOLLIN});
    printf("epoll %d", epoll_wait(all, &(struct epoll_event){0}, 1, 5));
    say(" at");
    printf("epoll %d", epoll_wait(all, &(struct epoll_event){0}, 1, 500));
    say(" at");
    timerfd_settime(handle, 0, &(struct itimerspec){0}, NULL);
    struct pollfd own = {handle, POLLIN, 0};
    printf("poll %d", poll(&own, 1, 250));
    say(" at");
    return 0;
}
