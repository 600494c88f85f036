/* Functions of a path: device nodes of the robot, its memory, and its configuration files. */

#include "shim.h"

#include <dirent.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

const char *copy_path(const char *path, char *copy) {
    size_t page = 4096, length = 0;
    while (length < PATH_MAX) {
        size_t count = page - (uintptr_t)(path + length) % page;
        count = count < PATH_MAX - length ? count : PATH_MAX - length;
        if (copy_memory(copy + length, path + length, count))
            return path;
        if (memchr(copy + length, 0, count))
            return copy;
        length += count;
    }
    return path;
}

/* Number of a node, or 0, and the path of a file. */
struct place { int node; const char *path; };

/* Find a path in the table of the robot's paths: number and path of each, separated by colons; `*` stands for
   any end. The number of a file is 0; the twin's folder has it. A node is a character device as /dev/null. */
static struct place find(const char *path, char *buffer) {
    char copy[PATH_MAX], *start;
    const char *entry = twin_variable(PATHS), *folder = twin_variable(FILES);
    if (!entry || !folder || !path || copy_path(path, copy) != copy)
        return (struct place){0, path};
    while (*entry) {
        int node = strtol(entry, &start, 10);
        size_t length = strcspn(start, ":");
        int is_open = length && start[length - 1] == '*';
        if (!strncmp(copy, start, length - is_open) && (is_open || !copy[length])) {
            int fits = snprintf(buffer, PATH_MAX, "%s%s", folder, copy) < PATH_MAX;
            return (struct place){node, node ? "/dev/null" : fits ? buffer : path};
        }
        entry = start + length + (start[length] == ':');
    }
    return (struct place){0, path};
}

#define DEFINE_OPEN(name, lead, pass)                                                                        \
    int name(lead const char *path, int flags, ...) {                                                        \
        char buffer[PATH_MAX];                                                                               \
        struct place place = find(path, buffer);                                                             \
        va_list rest;                                                                                        \
        va_start(rest, flags);                                                                               \
        mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;                            \
        va_end(rest);                                                                                        \
        return place.node ? open_node(place.node, flags) : REAL(name)(pass place.path, flags, mode);         \
    }
#define NONE
#define FOLDER int folder,
#define AT folder,
DEFINE_OPEN(open, NONE, NONE)
DEFINE_OPEN(open64, NONE, NONE)
DEFINE_OPEN(openat, FOLDER, AT)
DEFINE_OPEN(openat64, FOLDER, AT)

int __open_2(const char *path, int flags) { return open(path, flags); }
int __open64_2(const char *path, int flags) { return open64(path, flags); }
int __openat_2(int folder, const char *path, int flags) { return openat(folder, path, flags); }
int __openat64_2(int folder, const char *path, int flags) { return openat64(folder, path, flags); }
int creat(const char *path, mode_t mode) { return open(path, O_CREAT | O_WRONLY | O_TRUNC, mode); }
int creat64(const char *path, mode_t mode) { return open64(path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

/* A stream of a node serves only ioctl, by its file descriptor; its bytes are refused (EPERM). */
#define DEFINE_FOPEN(fopen, freopen)                                                                         \
    FILE *fopen(const char *path, const char *mode) {                                                        \
        char buffer[PATH_MAX];                                                                               \
        struct place place = find(path, buffer);                                                             \
        if (!place.node)                                                                                     \
            return REAL(fopen)(place.path, mode);                                                            \
        int fd = open_node(place.node, strchr(mode, 'e') ? O_CLOEXEC : 0);                                   \
        FILE *stream = fd < 0 ? NULL : fdopen(fd, mode);                                                     \
        if (fd >= 0 && !stream)                                                                              \
            close(fd);                                                                                       \
        return stream;                                                                                       \
    }                                                                                                        \
    FILE *freopen(const char *path, const char *mode, FILE *stream) {                                        \
        char buffer[PATH_MAX];                                                                               \
        struct place place = find(path, buffer);                                                             \
        if (!place.node)                                                                                     \
            return REAL(freopen)(place.path, mode, stream);                                                  \
        int fd = open_node(place.node, O_CLOEXEC);                                                           \
        snprintf(buffer, sizeof buffer, "/proc/self/fd/%d", fd);                                             \
        stream = fd < 0 ? NULL : REAL(freopen)(buffer, mode, stream);                                        \
        if (stream)                                                                                          \
            mark_node(fd, place.node); /* which mode "w" removes */                                          \
        if (fd >= 0)                                                                                         \
            close(fd);                                                                                       \
        return stream;                                                                                       \
    }
DEFINE_FOPEN(fopen, freopen)
DEFINE_FOPEN(fopen64, freopen64)

#define PATH_CALL(type, name, parameters, before, after)                                                     \
    type name parameters {                                                                                   \
        char buffer[PATH_MAX];                                                                               \
        return REAL(name)(before find(path, buffer).path after);                                             \
    }
#define COMMA ,
PATH_CALL(int, access, (const char *path, int mode), , COMMA mode)
PATH_CALL(int, euidaccess, (const char *path, int mode), , COMMA mode)
PATH_CALL(int, eaccess, (const char *path, int mode), , COMMA mode)
PATH_CALL(int, faccessat, (int folder, const char *path, int mode, int flags), AT, COMMA mode COMMA flags)
PATH_CALL(int, stat, (const char *path, struct stat *status), , COMMA status)
PATH_CALL(int, stat64, (const char *path, struct stat64 *status), , COMMA status)
PATH_CALL(int, lstat, (const char *path, struct stat *status), , COMMA status)
PATH_CALL(int, lstat64, (const char *path, struct stat64 *status), , COMMA status)
PATH_CALL(int, fstatat, (int folder, const char *path, struct stat *status, int flags), AT,
      COMMA status COMMA flags)
PATH_CALL(int, fstatat64, (int folder, const char *path, struct stat64 *status, int flags), AT,
      COMMA status COMMA flags)
PATH_CALL(int, statx, (int folder, const char *path, int flags, unsigned int mask, struct statx *status), AT,
      COMMA flags COMMA mask COMMA status)
PATH_CALL(DIR *, opendir, (const char *path), , )

/* Names in programs for older C libraries, or of 32 bits with 64-bit times. */
extern int __xstat(int, const char *, void *), __xstat64(int, const char *, void *);
extern int __lxstat(int, const char *, void *), __lxstat64(int, const char *, void *);
extern int __stat64_time64(const char *, void *), __lstat64_time64(const char *, void *);
PATH_CALL(int, __xstat, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __xstat64, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __lxstat, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __lxstat64, (int version, const char *path, void *status), version COMMA, COMMA status)
PATH_CALL(int, __stat64_time64, (const char *path, void *status), , COMMA status)
PATH_CALL(int, __lstat64_time64, (const char *path, void *status), , COMMA status)

/* Functions of a file descriptor: that of a node is a character device, too. */
#define FD_CALL(name, lead, type, pass)                                                                      \
    extern int name(lead int fd, type *status);                                                              \
    int name(lead int fd, type *status) {                                                                    \
        int null = node_of_fd(fd) ? REAL(open)("/dev/null", O_PATH | O_CLOEXEC) : -1;                        \
        int result = REAL(name)(pass null < 0 ? fd : null, status);                                          \
        if (null >= 0)                                                                                       \
            REAL(close)(null);                                                                               \
        return result;                                                                                       \
    }
#define VERSION int version,
#define WITH_VERSION version,
FD_CALL(fstat, NONE, struct stat, NONE)
FD_CALL(fstat64, NONE, struct stat64, NONE)
FD_CALL(__fxstat, VERSION, void, WITH_VERSION)
FD_CALL(__fxstat64, VERSION, void, WITH_VERSION)
FD_CALL(__fstat64_time64, NONE, void, NONE)
