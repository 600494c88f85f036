/* The simulated clock of the preload library: functions that return the time or wait.

   Times are those of the twin [ns], from 0. CLOCK_REALTIME starts at `FIRST_DAY`, all other clocks at 0. */

#include "shim.h"

#include <aio.h>
#include <mqueue.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/select.h>
#include <sys/sem.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/timeb.h>
#include <sys/times.h>
#include <termios.h>
#include <threads.h>

#define FIRST_DAY (1767225600 * BILLION) /* 2026-01-01, 0:00 UTC */

int64_t now(void) {
    int64_t value = 0;
    exchange(NOW, 0, NULL, 0, NULL, 0, &value);
    return value;
}

int64_t to_ns(int64_t seconds, int64_t ns) {
    return seconds > NEVER / 2 / BILLION ? NEVER / 2 : seconds * BILLION + ns;
}

/* Convert a time of any clock to the twin's: clocks that start at 0 never reach the first day. */
int64_t since_start(const struct timespec *time) {
    int64_t ns = ns_of(time);
    return ns >= FIRST_DAY ? ns - FIRST_DAY : ns;
}

/* Clocks ------------------------------------------------------------------------------------------------- */

int clock_gettime(clockid_t clock, struct timespec *time) {
    if (!simulated)
        return REAL(clock_gettime)(clock, time);
    int dated = clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE || clock == CLOCK_TAI;
    *time = time_of(now() + (dated ? FIRST_DAY : 0));
    return 0;
}

int clock_getres(clockid_t clock, struct timespec *time) {
    if (!simulated)
        return REAL(clock_getres)(clock, time);
    if (time)
        *time = time_of(1);
    return 0;
}

int gettimeofday(struct timeval *time, void *zone) {
    if (!simulated)
        return REAL(gettimeofday)(time, zone);
    *time = us_of(now() + FIRST_DAY);
    return 0;
}

time_t time(time_t *result) {
    time_t seconds = simulated ? (now() + FIRST_DAY) / BILLION : REAL(time)(NULL);
    if (result)
        *result = seconds;
    return seconds;
}

int timespec_get(struct timespec *time, int base) {
    if (!simulated || base != TIME_UTC)
        return REAL(timespec_get)(time, base);
    *time = time_of(now() + FIRST_DAY);
    return base;
}

int ftime(struct timeb *time) {
    int64_t ms = simulated ? (now() + FIRST_DAY) / 1000000 : 0;
    if (!simulated) {
        struct timespec real;
        REAL(clock_gettime)(CLOCK_REALTIME, &real);
        ms = ns_of(&real) / 1000000;
    }
    *time = (struct timeb){.time = ms / 1000, .millitm = ms % 1000};
    return 0;
}

/* Processor time is the elapsed time. */
clock_t clock(void) { return simulated ? now() / (BILLION / CLOCKS_PER_SEC) : REAL(clock)(); }

clock_t times(struct tms *result) {
    if (!simulated)
        return REAL(times)(result);
    clock_t ticks = now() / (BILLION / sysconf(_SC_CLK_TCK));
    if (result)
        *result = (struct tms){.tms_utime = ticks};
    return ticks;
}

/* Clocks cannot be set. */
REPLACE(clock_settime, (clockid_t clock, const struct timespec *time), (clock, time), c_result(-EPERM))
REPLACE(settimeofday, (const struct timeval *time, const struct timezone *zone), (time, zone),
        c_result(-EPERM))

/* Waits for a time --------------------------------------------------------------------------------------- */

REPLACE(usleep, (useconds_t us), (us),
        c_result(wait_until(RELATIVE, (struct limit){us * 1000LL}, NULL, 0, NULL, NULL)))

unsigned int sleep(unsigned int seconds) {
    int64_t left = 0;
    if (!simulated)
        return REAL(sleep)(seconds);
    return wait_until(RELATIVE, (struct limit){seconds * BILLION}, NULL, 0, NULL, &left) && left > 0
               ? (left + BILLION / 2) / BILLION
               : 0;
}

/* Return 0 or an error number. */
static int sleep_for(enum sleep kind, const struct timespec *requested, struct timespec *left) {
    struct timespec time;
    int64_t remaining = 0;
    if (copy_memory(&time, requested, sizeof time))
        return EFAULT;
    if (time.tv_sec < 0 || time.tv_nsec < 0 || time.tv_nsec >= BILLION)
        return EINVAL;
    struct limit limit = {kind == ABSOLUTE ? since_start(&time) : ns_of(&time)};
    int error = -wait_until(kind, limit, NULL, 0, NULL, &remaining);
    time = time_of(remaining > 0 ? remaining : 0);
    if (error && left && kind == RELATIVE && copy_memory(left, &time, sizeof time))
        return EFAULT;
    return error;
}

/* True if a file descriptor leads to another program: a socket, unless its peer is this process or its parent,
   or a terminal that does not control this program. A wait for it then takes time of the wall clock. */
static int leads_outside(int fd) {
    struct ucred peer = {0};
    socklen_t size = sizeof peer;
    int domain;
    if (isatty(fd))
        return tcgetsid(fd) < 0;
    if (getsockopt(fd, SOL_SOCKET, SO_DOMAIN, &domain, &(socklen_t){sizeof domain}))
        return 0;
    return domain != AF_UNIX || (!getsockopt(fd, SOL_SOCKET, SO_PEERCRED, &peer, &size) && peer.pid > 0 &&
                                 peer.pid != getpid() && peer.pid != getppid());
}

/* True if a file descriptor leads to another program, or is an epoll instance with such a member, by the
   kernel's list of them. */
static int is_external(int fd) {
    char path[64], line[256];
    struct stat status;
    int member, external = leads_outside(fd);
    if (external || REAL(fstat)(fd, &status) || status.st_mode & S_IFMT)
        return external; /* an epoll instance has no type */
    snprintf(path, sizeof path, "/proc/self/fdinfo/%d", fd);
    FILE *file = REAL(fopen)(path, "re");
    while (file && fgets(line, sizeof line, file))
        external |= sscanf(line, "tfd: %d", &member) == 1 && leads_outside(member);
    if (file)
        fclose(file);
    return external;
}

REPLACE(nanosleep, (const struct timespec *requested, struct timespec *left), (requested, left),
        c_result(-sleep_for(RELATIVE, requested, left)))

REPLACE(clock_nanosleep,
        (clockid_t clock, int flags, const struct timespec *requested, struct timespec *left),
        (clock, flags, requested, left),
        sleep_for(flags & TIMER_ABSTIME ? ABSOLUTE : RELATIVE, requested, left))

/* Waits for file descriptors ----------------------------------------------------------------------------- */

/* Return the number of ready descriptors, or minus an error number; a time-out below 0 is none. */
static int poll_for(struct pollfd *fds, nfds_t count, int64_t ns, const sigset_t *mask, int64_t *left) {
    struct timespec no_wait = {0, 0};
    int external = 0;
    *left = ns > 0 ? ns : 0;
    int n_ready = REAL(ppoll)(fds, count, &no_wait, mask);
    if (n_ready)
        return n_ready < 0 ? -errno : n_ready;
    if (!ns) {
        now(); /* poll with time-out 0 takes time, so that a polling loop ends */
        return 0;
    }
    for (nfds_t i = 0; ns > 0 && i < count && !external; i++)
        external = fds[i].fd < 0 ? 0 : is_external(fds[i].fd);
    enum sleep kind = (ns < 0 ? ABSOLUTE : RELATIVE) | (external ? EXTERNAL : 0);
    int error = wait_until(kind, (struct limit){ns < 0 ? NEVER : ns}, fds, count, mask, left);
    n_ready = REAL(ppoll)(fds, count, &no_wait, NULL);
    return n_ready ? n_ready : error;
}

/* Convert a time-out to ns, -1 for none; return 0, or -1 and an error number. */
static int read_limit(const struct timespec *limit, int64_t *ns) {
    struct timespec time;
    *ns = -1;
    if (!limit)
        return 0;
    if (copy_memory(&time, limit, sizeof time))
        return -1;
    if (time.tv_sec < 0 || time.tv_nsec < 0 || time.tv_nsec >= BILLION)
        return c_result(-EINVAL);
    *ns = ns_of(&time);
    return 0;
}

REPLACE(poll, (struct pollfd *fds, nfds_t count, int ms), (fds, count, ms),
        c_result(poll_for(fds, count, ms * 1000000LL, NULL, &(int64_t){0})))

int ppoll(struct pollfd *fds, nfds_t count, const struct timespec *limit, const sigset_t *mask) {
    int64_t left, ns;
    if (!simulated)
        return REAL(ppoll)(fds, count, limit, mask);
    return read_limit(limit, &ns) ? -1 : c_result(poll_for(fds, count, ns, mask, &left));
}

int __poll_chk(struct pollfd *fds, nfds_t count, int ms, size_t size) { return poll(fds, count, ms); }

int __ppoll_chk(struct pollfd *fds, nfds_t count, const struct timespec *limit, const sigset_t *mask,
                size_t size) {
    return ppoll(fds, count, limit, mask);
}

/* Select by poll: convert the three sets to events, and ready events back to sets. */
static int select_for(int count, fd_set *sets[3], int64_t ns, const sigset_t *mask, int64_t *left) {
    static const short requested_events[] = {POLLIN, POLLOUT, POLLPRI};
    static const short ready_events[] = {POLLIN | POLLHUP | POLLERR, POLLOUT | POLLERR, POLLPRI};
    fd_set copies[3];
    if (count < 0 || count > FD_SETSIZE)
        return -EINVAL;
    for (int k = 0; k < 3; k++)
        if (sets[k] && copy_memory(&copies[k], sets[k], (count + 7) / 8))
            return -EFAULT;
    struct pollfd fds[FD_SETSIZE];
    int n_fds = 0, n_ready = 0;
    for (int i = 0; i < count; i++) {
        short events = 0;
        for (int k = 0; k < 3; k++)
            events |= sets[k] && FD_ISSET(i, &copies[k]) ? requested_events[k] : 0;
        if (events)
            fds[n_fds++] = (struct pollfd){i, events, 0};
    }
    int result = poll_for(fds, n_fds, ns, mask, left);
    for (int i = 0; i < n_fds; i++)
        if (fds[i].revents & POLLNVAL)
            result = -EBADF;
    for (int i = 0; result >= 0 && i < n_fds; i++)
        for (int k = 0; k < 3; k++) {
            if (!sets[k] || !FD_ISSET(fds[i].fd, sets[k]))
                continue;
            if (fds[i].revents & ready_events[k])
                n_ready++;
            else
                FD_CLR(fds[i].fd, sets[k]);
        }
    return result < 0 ? result : n_ready;
}

int select(int count, fd_set *in, fd_set *out, fd_set *odd, struct timeval *limit) {
    int64_t left;
    struct timeval time = {0, 0};
    if (!simulated)
        return REAL(select)(count, in, out, odd, limit);
    if (limit && copy_memory(&time, limit, sizeof time))
        return -1;
    if (time.tv_sec < 0 || time.tv_usec < 0)
        return c_result(-EINVAL);
    int result = select_for(count, (fd_set *[]){in, out, odd}, limit ? ns_of_us(&time) : -1, NULL, &left);
    if (limit)
        *limit = us_of(left > 0 ? left : 0);
    return c_result(result);
}

int pselect(int count, fd_set *in, fd_set *out, fd_set *odd, const struct timespec *limit,
            const sigset_t *mask) {
    int64_t left, ns;
    if (!simulated)
        return REAL(pselect)(count, in, out, odd, limit, mask);
    if (read_limit(limit, &ns))
        return -1;
    return c_result(select_for(count, (fd_set *[]){in, out, odd}, ns, mask, &left));
}

static int epoll_for(int fd, struct epoll_event *events, int size, int64_t ns, const sigset_t *mask) {
    struct pollfd poll_fd = {fd, POLLIN, 0};
    int64_t left;
    int result = poll_for(&poll_fd, 1, ns, mask, &left);
    return result < 0 ? c_result(result) : REAL(epoll_pwait)(fd, events, size, 0, NULL);
}

REPLACE(epoll_pwait, (int fd, struct epoll_event *events, int size, int ms, const sigset_t *mask),
        (fd, events, size, ms, mask), epoll_for(fd, events, size, ms * 1000000LL, mask))

int epoll_pwait2(int fd, struct epoll_event *events, int size, const struct timespec *limit,
                 const sigset_t *mask) {
    int64_t ns;
    if (!simulated)
        return REAL(epoll_pwait2)(fd, events, size, limit, mask);
    return read_limit(limit, &ns) ? -1 : epoll_for(fd, events, size, ns, mask);
}

REPLACE(epoll_wait, (int fd, struct epoll_event *events, int size, int ms), (fd, events, size, ms),
        epoll_pwait(fd, events, size, ms, NULL))

/* Sockets with a time-out (SO_RCVTIMEO): wait before the call; return 0, or -1 and EAGAIN or EINTR. */
int wait_to_receive(int fd, int flags) {
    struct timeval limit = {0, 0};
    struct pollfd poll_fd = {fd, POLLIN, 0};
    int64_t left;
    int saved_errno = errno;
    if (!simulated || flags & MSG_DONTWAIT ||
        getsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &limit, &(socklen_t){sizeof limit}) || !ns_of_us(&limit))
        return errno = saved_errno, 0;
    int result = poll_for(&poll_fd, 1, ns_of_us(&limit), NULL, &left);
    return result > 0 ? 0 : c_result(result ? result : -EAGAIN);
}

#define RECEIVE_CALL(type, name, parameters, flags, ...)                                                     \
    type name parameters { return wait_to_receive(fd, flags) ? -1 : REAL(name)(fd, __VA_ARGS__); }
RECEIVE_CALL(ssize_t, recv, (int fd, void *content, size_t count, int flags), flags, content, count, flags)
RECEIVE_CALL(ssize_t, recvfrom,
             (int fd, void *content, size_t count, int flags, struct sockaddr *peer, socklen_t *size), flags,
             content, count, flags, peer, size)
RECEIVE_CALL(ssize_t, recvmsg, (int fd, struct msghdr *message, int flags), flags, message, flags)
RECEIVE_CALL(int, accept, (int fd, struct sockaddr *peer, socklen_t *size), 0, peer, size)
RECEIVE_CALL(int, accept4, (int fd, struct sockaddr *peer, socklen_t *size, int flags), 0, peer, size, flags)
ssize_t __recv_chk(int fd, void *content, size_t count, size_t size, int flags) {
    return recv(fd, content, count, flags);
}
ssize_t __recvfrom_chk(int fd, void *content, size_t count, size_t size, int flags, struct sockaddr *peer,
                       socklen_t *peer_size) {
    return recvfrom(fd, content, count, flags, peer, peer_size);
}

/* Other waits: retries every millisecond ------------------------------------------------------------------ */

/* `is_busy` must not sleep in the kernel, not even for a time-out of 0: simulated time might then pass. */
#define RETRY(end, is_busy)                                                                                  \
    do {                                                                                                     \
        int64_t end_ns = end;                                                                                \
        while ((is_busy) && now() < end_ns)                                                                  \
            wait_until(RELATIVE, (struct limit){BILLION / 1000}, NULL, 0, NULL, NULL);                       \
    } while (0)

static const struct timespec no_wait = {0, 0};

int sigtimedwait(const sigset_t *signals, siginfo_t *info, const struct timespec *limit) {
    int number;
    int64_t ns;
    if (!simulated || !limit)
        return REAL(sigtimedwait)(signals, info, limit);
    if (read_limit(limit, &ns))
        return -1;
    RETRY(now() + ns, (number = REAL(sigtimedwait)(signals, info, &no_wait)) < 0 && errno == EAGAIN);
    return number;
}

int semtimedop(int id, struct sembuf *operations, size_t count, const struct timespec *limit) {
    int result;
    int64_t ns;
    struct sembuf copies[count < 500 ? count : 500];
    if (!simulated || !limit || count > 500)
        return REAL(semtimedop)(id, operations, count, limit);
    if (read_limit(limit, &ns) || copy_memory(copies, operations, count * sizeof *copies))
        return -1;
    for (size_t i = 0; i < count; i++)
        copies[i].sem_flg |= IPC_NOWAIT;
    RETRY(now() + ns, (result = REAL(semop)(id, copies, count)) && errno == EAGAIN);
    return result;
}

static int is_in_progress(const struct aiocb *const requests[], int count) {
    for (int i = 0; i < count; i++)
        if (requests[i] && aio_error(requests[i]) != EINPROGRESS)
            return 0;
    return 1;
}

int aio_suspend(const struct aiocb *const requests[], int count, const struct timespec *limit) {
    int64_t ns;
    if (!simulated || !limit)
        return REAL(aio_suspend)(requests, count, limit);
    if (read_limit(limit, &ns))
        return -1;
    RETRY(now() + ns, is_in_progress(requests, count));
    return is_in_progress(requests, count) ? c_result(-EAGAIN) : 0;
}

/* Wait for a message queue, which is a file descriptor on Linux, before the call. */
static void wait_for_queue(mqd_t queue, short events, const struct timespec *limit) {
    struct pollfd poll_fd = {(int)queue, events, 0};
    if (simulated)
        RETRY(since_start(limit), !REAL(poll)(&poll_fd, 1, 0));
}

ssize_t mq_timedreceive(mqd_t queue, char *content, size_t size, unsigned int *priority,
                        const struct timespec *limit) {
    wait_for_queue(queue, POLLIN, limit);
    return REAL(mq_timedreceive)(queue, content, size, priority, simulated ? &no_wait : limit);
}

int mq_timedsend(mqd_t queue, const char *content, size_t size, unsigned int priority,
                 const struct timespec *limit) {
    wait_for_queue(queue, POLLOUT, limit);
    return REAL(mq_timedsend)(queue, content, size, priority, simulated ? &no_wait : limit);
}

int pthread_timedjoin_np(pthread_t thread, void **result, const struct timespec *limit) {
    int error;
    if (!simulated || !limit)
        return REAL(pthread_timedjoin_np)(thread, result, limit);
    RETRY(since_start(limit), (error = pthread_tryjoin_np(thread, result)) == EBUSY);
    return error == EBUSY ? ETIMEDOUT : error;
}

REPLACE(pthread_clockjoin_np,
        (pthread_t thread, void **result, clockid_t clock, const struct timespec *limit),
        (thread, result, clock, limit), pthread_timedjoin_np(thread, result, limit))

/* C11: -1 after a signal handler, below -1 after another error. */
int thrd_sleep(const struct timespec *requested, struct timespec *left) {
    int error = simulated ? sleep_for(RELATIVE, requested, left) : 0;
    return !simulated ? REAL(thrd_sleep)(requested, left) : error ? (error == EINTR ? -1 : -2) : 0;
}
