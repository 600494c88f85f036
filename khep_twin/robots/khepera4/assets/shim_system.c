/* `syscall`: calls of the kernel by number, as C++'s, Rust's and Node's run times make them. */

#include "shim.h"

#include <fcntl.h>
#include <stdarg.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <sys/uio.h>

#define I(index) (int)arguments[index]
#define P(index) (void *)arguments[index]

/* Calls of the clock; return 0 if it is none of them. */
static int call_clock(long number, const long *arguments, long *result) {
    struct { const sigset_t *signals; size_t size; } mask = {NULL, 0};
    switch (number) {
    case SYS_clock_gettime:
        return *result = clock_gettime(I(0), P(1)), 1;
    case SYS_clock_getres:
        return *result = clock_getres(I(0), P(1)), 1;
    case SYS_gettimeofday:
        return *result = gettimeofday(P(0), P(1)), 1;
    case SYS_nanosleep:
        return *result = nanosleep(P(0), P(1)), 1;
    case SYS_clock_nanosleep:
        return *result = c_result(-clock_nanosleep(I(0), I(1), P(2), P(3))), 1;
    case SYS_ppoll:
        return *result = ppoll(P(0), arguments[1], P(2), P(3)), 1;
    case SYS_pselect6:
        if (arguments[5] && copy_memory(&mask, P(5), sizeof mask))
            return *result = -1, 1;
        return *result = pselect(I(0), P(1), P(2), P(3), P(4), mask.signals), 1;
    case SYS_epoll_pwait:
        return *result = epoll_pwait(I(0), P(1), I(2), I(3), P(4)), 1;
    case SYS_timerfd_create:
        return *result = timerfd_create(I(0), I(1)), 1;
    case SYS_timerfd_settime:
        return *result = timerfd_settime(I(0), I(1), P(2), P(3)), 1;
    case SYS_timerfd_gettime:
        return *result = timerfd_gettime(I(0), P(1)), 1;
    case SYS_futex:
        return *result = call_futex(P(0), I(1), I(2), P(3), P(4), I(5)), 1;
#ifdef SYS_poll /* older calls, which not all processors have */
#if __WORDSIZE == 64
    case SYS_select: /* with an argument of another form in 32 bits */
        return *result = select(I(0), P(1), P(2), P(3), P(4)), 1;
#endif
    case SYS_time:
        return *result = time(P(0)), 1;
    case SYS_poll:
        return *result = poll(P(0), arguments[1], I(2)), 1;
    case SYS_epoll_wait:
        return *result = epoll_wait(I(0), P(1), I(2), I(3)), 1;
#endif
    }
    return 0;
}

long syscall(long number, ...) {
    long arguments[6], result;
    va_list rest;
    va_start(rest, number);
    for (int i = 0; i < 6; i++)
        arguments[i] = va_arg(rest, long);
    va_end(rest);
    switch (number) {
    case SYS_read:
        return read(I(0), P(1), arguments[2]);
    case SYS_write:
        return write(I(0), P(1), arguments[2]);
    case SYS_readv:
        return readv(I(0), P(1), I(2));
    case SYS_writev:
        return writev(I(0), P(1), I(2));
    case SYS_ioctl:
        return ioctl(I(0), arguments[1], P(2));
    case SYS_openat:
        return openat(I(0), P(1), I(2), I(3));
    case SYS_execve:
        return execve(P(0), P(1), P(2));
    case SYS_execveat:
        return execveat(I(0), P(1), P(2), P(3), I(4));
#ifdef SYS_open
    case SYS_open:
        return open(P(0), I(1), I(2));
#endif
    }
    if (simulated && call_clock(number, arguments, &result))
        return result;
    return REAL(syscall)(number, arguments[0], arguments[1], arguments[2], arguments[3], arguments[4],
                         arguments[5]);
}
