/* Devices and clock of a robot for a program that was compiled on this machine.

   A preload library: LD_PRELOAD loads it before the C library, so that its functions replace those of the
   same names. It answers the device nodes of the robot and, with a simulated clock, the functions that return
   the time or wait, by requests to the twin on a socket, named in KHEP_TWIN_SOCKET. The server and the
   messages are in `khep_twin/programs/device_server.py`. */

#include "shim.h"

#include <fcntl.h>
#include <sched.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <sys/un.h>

/* A signal handler that interrupts a sleeping thread uses another connection; after a longjmp out of it that
   connection stays open. */
#define MAX_CONNECTIONS 8
#define MAX_FDS 4096

struct header { uint32_t kind, number, count; };
struct reply { int32_t result; uint32_t count; int64_t value; };

int simulated;
static uint64_t inodes[MAX_FDS]; /* of private file descriptors, 0 for others */
static __thread struct { struct private sockets[MAX_CONNECTIONS]; int depth; } connections;
static pthread_key_t thread_end;

/* Private file descriptors ------------------------------------------------------------------------------- */

/* Return the kernel's number of a socket, 0 if the file descriptor is closed or no socket. */
uint64_t socket_inode(int fd) {
    struct statx status;
    if (fd < 0 || REAL(statx)(fd, "", AT_EMPTY_PATH, STATX_TYPE | STATX_INO, &status))
        return 0;
    return S_ISSOCK(status.stx_mode) ? status.stx_ino : 0;
}

int is_open(struct private socket) { return socket.inode && socket_inode(socket.fd) == socket.inode; }

/* Move a socket to a high number: programs expect low ones. */
struct private protect(int fd) {
    int high = fcntl(fd, F_DUPFD_CLOEXEC, 512);
    if (high >= 0)
        REAL(close)(fd);
    else
        high = fd;
    struct private socket = {high, socket_inode(high)};
    if (high >= 0 && high < MAX_FDS)
        inodes[high] = socket.inode;
    return socket;
}

int copy_memory(void *target, const void *source, size_t size) {
    struct iovec to = {target, size}, from = {(void *)source, size};
    if (!size || process_vm_readv(getpid(), &to, 1, &from, 1, 0) == (ssize_t)size)
        return 0;
    if (errno != EPERM && errno != ENOSYS)
        return c_result(-EFAULT);
    memcpy(target, source, size); /* in a container that forbids this call */
    return 0;
}

/* Connections -------------------------------------------------------------------------------------------- */

static void disconnect(void *unused) {
    for (int i = 0; i < MAX_CONNECTIONS; i++)
        if (is_open(connections.sockets[i]))
            REAL(close)(connections.sockets[i].fd);
    memset(&connections, 0, sizeof connections);
}

static void start_child(void) {
    for (int fd = 0; fd < MAX_FDS; fd++)
        if (is_open((struct private){fd, inodes[fd]}))
            REAL(close)(fd);
    memset(inodes, 0, sizeof inodes);
    memset(&connections, 0, sizeof connections);
    forget_timers();
    forget_locks();
    say_hello();
}

__attribute__((constructor)) static void initialize(void) {
    keep_variables();
    const char *clock = twin_variable(CLOCK);
    simulated = clock && !strcmp(clock, "simulated");
    pthread_key_create(&thread_end, disconnect);
    pthread_atfork(NULL, NULL, start_child);
    if (simulated) /* all threads share one processor: a woken one does not preempt the running one */
        sched_setscheduler(0, SCHED_BATCH, &(struct sched_param){0});
    say_hello();
}

static int transmit(int fd, void *content, size_t count, int out) {
    char *position = content;
    while (count) {
        ssize_t n = out ? send(fd, position, count, MSG_NOSIGNAL) : REAL(recv)(fd, position, count, 0);
        if (n < 0 && errno == EINTR)
            continue;
        if (n <= 0)
            return -1;
        position += n;
        count -= n;
    }
    return 0;
}

/* End the program without its twin. */
static void exit_without_twin(void) {
    static const char message[] = "khep-twin: the twin has ended, and this program with it\n";
    (void)!REAL(write)(2, message, sizeof message - 1);
    _exit(1);
}

/* End the program without its twin, unless the program itself has closed the connection: then return. */
static void check_connection(struct private socket) {
    if (is_open(socket))
        exit_without_twin();
}

/* Return the connection for requests, -1 outside a twin. A new one waits until it is scheduled. */
static struct private get_connection(void) {
    struct private none = {-1, 0};
    if (connections.depth == MAX_CONNECTIONS)
        disconnect(NULL);
    if (is_open(connections.sockets[connections.depth]))
        return connections.sockets[connections.depth];
    const char *path = twin_variable(SOCKET);
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (!path || strlen(path) >= sizeof address.sun_path)
        return none;
    strcpy(address.sun_path, path);
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0)
        return none;
    struct header hello = {HELLO, gettid(), 0};
    struct reply reply;
    struct private connection = protect(fd);
    if (connect(connection.fd, (struct sockaddr *)&address, sizeof address) ||
        transmit(connection.fd, &hello, sizeof hello, 1) ||
        transmit(connection.fd, &reply, sizeof reply, 0))
        exit_without_twin();
    pthread_setspecific(thread_end, &connections);
    return connections.sockets[connections.depth] = connection;
}

/* Signals and cancellation of the thread are blocked during a request. */
struct state { sigset_t signals; int cancel; };

static void block(struct state *saved) {
    sigset_t signals;
    sigfillset(&signals);
    pthread_sigmask(SIG_BLOCK, &signals, &saved->signals);
    pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, &saved->cancel);
}

static void restore(const struct state *saved) {
    pthread_setcancelstate(saved->cancel, NULL);
    pthread_sigmask(SIG_SETMASK, &saved->signals, NULL);
}

void say_hello(void) {
    struct state saved;
    block(&saved);
    get_connection();
    restore(&saved);
}

/* Send a request and receive its reply; return the result, or minus an error number. */
int exchange(enum request kind, uint32_t number, const void *content, uint32_t count, void *output,
             uint32_t size, int64_t *value) {
    unsigned char buffer[256];
    struct header header = {kind, number, count};
    struct reply reply;
    int small = count <= sizeof buffer - sizeof header, result = -ENODEV, saved_errno = errno;
    struct state saved;
    block(&saved);
    struct private socket = get_connection();
    memcpy(buffer, &header, sizeof header);
    if (small && count)
        memcpy(buffer + sizeof header, content, count);
    while (socket.fd >= 0) {
        if (!transmit(socket.fd, buffer, sizeof header + (small ? count : 0), 1) &&
            (small || !transmit(socket.fd, (void *)content, count, 1)) &&
            !transmit(socket.fd, &reply, sizeof reply, 0) && reply.count <= size &&
            !transmit(socket.fd, output, reply.count, 0)) {
            result = reply.result;
            if (value)
                *value = reply.value;
            break;
        }
        check_connection(socket);
        socket = get_connection();
    }
    restore(&saved);
    errno = saved_errno;
    return result;
}

/* Wait until a limit, or until file descriptors are ready; return 0, 1 after a WAKE, or minus an error number
   after a signal handler. `left` becomes the remaining time, below 0 if it took longer. */
int wait_until(enum sleep kind, struct limit limit, struct pollfd *fds, nfds_t count,
               const sigset_t *mask, int64_t *left) {
    struct { struct header header; struct limit limit; } __attribute__((packed)) message = {
        {SLEEP, kind, sizeof limit}, limit};
    struct header cancel = {CANCEL, 0, 0};
    struct reply reply;
    struct pollfd watched[count + 1];
    struct state saved;
    int error = 0, result = 0, saved_errno = errno;
    block(&saved);
    struct private connection = get_connection();
    if (connection.fd >= 0) {
        if (count)
            memcpy(watched, fds, count * sizeof *fds);
        watched[count] = (struct pollfd){connection.fd, POLLIN, 0};
        if (transmit(connection.fd, &message, sizeof message, 1))
            exit_without_twin();
        connections.depth++;
        pthread_setcancelstate(saved.cancel, NULL);
        if (REAL(ppoll)(watched, count + 1, NULL, mask ? mask : &saved.signals) < 0) {
            error = errno;
            watched[count].revents = 0;
        }
        pthread_setcancelstate(PTHREAD_CANCEL_DISABLE, NULL);
        connections.depth--;
        reply = (struct reply){limit.futex_address != 0, 0, 0};
        if (!is_open(connection))
            say_hello(); /* another thread has closed all descriptors of the program */
        else if ((!watched[count].revents && transmit(connection.fd, &cancel, sizeof cancel, 1)) ||
                 transmit(connection.fd, &reply, sizeof reply, 0))
            check_connection(connection);
        result = reply.result;
        if (left)
            *left = reply.value;
    }
    restore(&saved);
    errno = saved_errno;
    return result ? result : -error;
}

/* Wait until all other threads wait: a thread that was just woken runs beside the one that woke it. */
void wait_turn(void) {
    if (simulated)
        wait_until(RELATIVE, (struct limit){0}, NULL, 0, NULL, NULL);
}

void wake(uint32_t count, uint64_t futex_address, uint64_t number) {
    struct { struct header header; uint64_t futex_address, number; } __attribute__((packed)) message = {
        {WAKE, count, sizeof futex_address + sizeof number}, futex_address, number};
    struct state saved;
    block(&saved);
    struct private connection = get_connection();
    if (connection.fd >= 0 && transmit(connection.fd, &message, sizeof message, 1))
        exit_without_twin();
    restore(&saved);
}

/* Threads and processes ---------------------------------------------------------------------------------- */

struct thread_start { void *(*routine)(void *); void *argument; };

static void *run_thread(void *argument) {
    struct thread_start start = *(struct thread_start *)argument;
    free(argument);
    say_hello();
    return start.routine(start.argument);
}

/* A new thread starts when its creator waits. */
int pthread_create(pthread_t *thread, const pthread_attr_t *attr, void *(*routine)(void *), void *argument) {
    struct thread_start *start = simulated ? malloc(sizeof *start) : NULL;
    if (!start)
        return REAL(pthread_create)(thread, attr, routine, argument);
    *start = (struct thread_start){routine, argument};
    int error = REAL(pthread_create)(thread, attr, run_thread, start);
    if (error)
        free(start);
    return error;
}

/* As fork, since the child would change this library's memory; the parent waits as for vfork. */
pid_t vfork(void) {
    int ends[2];
    char byte;
    if (pipe2(ends, O_CLOEXEC))
        return -1;
    for (int i = 0; i < 2; i++) {
        int fd = fcntl(ends[i], F_DUPFD_CLOEXEC, 512);
        REAL(close)(ends[i]);
        ends[i] = fd;
    }
    pid_t child = fork();
    if (!child) {
        REAL(close)(ends[0]);
        return 0;
    }
    REAL(close)(ends[1]);
    while (child > 0 && REAL(read)(ends[0], &byte, 1) < 0 && errno == EINTR)
        ;
    REAL(close)(ends[0]);
    return child;
}

