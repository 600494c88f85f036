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
#define CALL(name, ...) case SYS_##name: return name(__VA_ARGS__);
#define CLOCK_CALL(name, ...) case SYS_##name: return *result = name(__VA_ARGS__), 1;

/* Calls of the clock; return 0 if it is none of them. */
static int call_clock(long number, const long *arguments, long *result) {
    struct { const sigset_t *signals; size_t size; } mask = {NULL, 0};
    switch (number) {
        CLOCK_CALL(clock_gettime, I(0), P(1))
        CLOCK_CALL(clock_getres, I(0), P(1))
        CLOCK_CALL(gettimeofday, P(0), P(1))
        CLOCK_CALL(nanosleep, P(0), P(1))
    case SYS_clock_nanosleep:
        return *result = c_result(-clock_nanosleep(I(0), I(1), P(2), P(3))), 1;
        CLOCK_CALL(ppoll, P(0), arguments[1], P(2), P(3))
    case SYS_pselect6:
        if (arguments[5] && copy_memory(&mask, P(5), sizeof mask))
            return *result = -1, 1;
        return *result = pselect(I(0), P(1), P(2), P(3), P(4), mask.signals), 1;
        CLOCK_CALL(epoll_pwait, I(0), P(1), I(2), I(3), P(4))
        CLOCK_CALL(timerfd_create, I(0), I(1))
        CLOCK_CALL(timerfd_settime, I(0), I(1), P(2), P(3))
        CLOCK_CALL(timerfd_gettime, I(0), P(1))
    case SYS_futex:
        return *result = call_futex(P(0), I(1), I(2), P(3), P(4), I(5)), 1;
#ifdef SYS_poll /* older calls, which not all processors have */
#if __WORDSIZE == 64
        CLOCK_CALL(select, I(0), P(1), P(2), P(3), P(4)) /* with an argument of another form in 32 bits */
#endif
        CLOCK_CALL(time, P(0))
        CLOCK_CALL(poll, P(0), arguments[1], I(2))
        CLOCK_CALL(epoll_wait, I(0), P(1), I(2), I(3))
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
        CALL(read, I(0), P(1), arguments[2])
        CALL(write, I(0), P(1), arguments[2])
        CALL(readv, I(0), P(1), I(2))
        CALL(writev, I(0), P(1), I(2))
        CALL(ioctl, I(0), arguments[1], P(2))
        CALL(openat, I(0), P(1), I(2), I(3))
        CALL(execve, P(0), P(1), P(2))
        CALL(execveat, I(0), P(1), P(2), P(3), I(4))
#ifdef SYS_open
        CALL(open, P(0), I(1), I(2))
#endif
    }
    if (simulated && call_clock(number, arguments, &result))
        return result;
    return REAL(syscall)(number, arguments[0], arguments[1], arguments[2], arguments[3], arguments[4],
                         arguments[5]);
}
