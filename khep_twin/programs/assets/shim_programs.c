/* Start of other programs: the twin checks that they load this library, and they inherit its variables. */

#include "shim.h"

#include <fcntl.h>
#include <limits.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/syscall.h>

extern char **environ;

static const char *const names[] = {"LD_PRELOAD", "KHEP_TWIN_SOCKET", "KHEP_TWIN_CLOCK", "KHEP_TWIN_PATHS",
                                    "KHEP_TWIN_FILES"};
#define N_NAMES 5
static char *variables[N_NAMES]; /* NAME=value; the program may remove them from its environment */

void keep_variables(void) {
    for (int i = 0; i < N_NAMES; i++) {
        const char *value = getenv(names[i]);
        if (value && asprintf(&variables[i], "%s=%s", names[i], value) < 0)
            variables[i] = NULL;
    }
}

const char *twin_variable(enum variable index) {
    return variables[index] ? variables[index] + strlen(names[index]) + 1 : getenv(names[index]);
}

/* Return an environment with the twin's variables. `copy` has room for its entries and those variables, and
   `preload` for two lists of libraries. */
static char *const *complete(char *const *environment, char **copy, char *preload) {
    int count = 0, is_changed = 0;
    for (; environment && environment[count]; count++)
        copy[count] = environment[count];
    for (int i = 0; i < N_NAMES && variables[SOCKET]; i++) {
        int entry = 0;
        size_t length = strlen(names[i]) + 1;
        while (entry < count && (strncmp(copy[entry], names[i], length - 1) || copy[entry][length - 1] != '='))
            entry++;
        if (!variables[i])
            continue;
        if (entry == count) {
            copy[count++] = variables[i];
            is_changed = 1;
        } else if (i == PRELOAD) {
            const char *last = strrchr(variables[i], ':');
            const char *library = last ? last + 1 : variables[i] + length;
            if (!strstr(copy[entry], library) &&
                snprintf(preload, 2 * PATH_MAX, "%s:%s", copy[entry], library) < 2 * PATH_MAX) {
                copy[entry] = preload;
                is_changed = 1;
            }
        }
    }
    copy[count] = NULL;
    return is_changed ? copy : environment;
}

static int count_entries(char *const *entries) {
    int count = 0;
    while (entries && entries[count])
        count++;
    return count;
}

/* Replace an environment by one with the twin's variables, until the end of the block. */
#define COMPLETE(environment)                                                                                \
    char *completed[count_entries(environment) + N_NAMES + 1], preload[2 * PATH_MAX];                        \
    environment = complete(environment, completed, preload)

/* Ask the twin about a program that is to be started; return 0, or -1 and an error number. */
static int check(const char *path) {
    char copy[PATH_MAX];
    if (copy_path(path, copy) != copy)
        return 0; /* which the kernel refuses */
    int result = exchange(EXEC, 0, copy, strlen(copy), NULL, 0, NULL);
    return result == -ENODEV ? 0 : c_result(result);
}

/* Return the path of a program by its name, in `buffer`; the name itself if there is none. */
static const char *find_program(const char *name, char *buffer) {
    char copy[PATH_MAX];
    const char *folder = getenv("PATH");
    if (!folder)
        folder = "/bin:/usr/bin";
    if (copy_path(name, copy) != copy || strchr(copy, '/'))
        return name;
    for (;; folder++) {
        int length = strcspn(folder, ":");
        if (snprintf(buffer, PATH_MAX, "%.*s%s%s", length, folder, length ? "/" : "", copy) < PATH_MAX &&
            !REAL(access)(buffer, X_OK))
            return buffer;
        folder += length;
        if (!*folder)
            return name;
    }
}

int execve(const char *path, char *const *arguments, char *const *environment) {
    COMPLETE(environment);
    return check(path) ? -1 : REAL(execve)(path, arguments, environment);
}

int execvpe(const char *name, char *const *arguments, char *const *environment) {
    char path[PATH_MAX];
    COMPLETE(environment);
    return check(find_program(name, path)) ? -1 : REAL(execvpe)(name, arguments, environment);
}

int execv(const char *path, char *const *arguments) { return execve(path, arguments, environ); }
int execvp(const char *name, char *const *arguments) { return execvpe(name, arguments, environ); }

#define DEFINE_EXECL(name, function, environment)                                                            \
    int name(const char *path, const char *first, ...) {                                                     \
        va_list rest;                                                                                        \
        int count = 1;                                                                                       \
        va_start(rest, first);                                                                               \
        while (va_arg(rest, char *))                                                                         \
            count++;                                                                                         \
        va_end(rest);                                                                                        \
        char *arguments[count + 1];                                                                          \
        arguments[0] = (char *)first;                                                                        \
        va_start(rest, first);                                                                               \
        for (int i = 1; i <= count; i++)                                                                     \
            arguments[i] = va_arg(rest, char *);                                                             \
        char *const *entries = environment;                                                                  \
        va_end(rest);                                                                                        \
        return function(path, arguments, entries);                                                           \
    }
DEFINE_EXECL(execl, execve, environ)
DEFINE_EXECL(execlp, execvpe, environ)
DEFINE_EXECL(execle, execve, va_arg(rest, char *const *))

int execveat(int folder, const char *path, char *const *arguments, char *const *environment, int flags) {
    char copy[PATH_MAX], full[PATH_MAX + 64];
    COMPLETE(environment);
    if (copy_path(path, copy) == copy && *copy != '/' && folder != AT_FDCWD) {
        snprintf(full, sizeof full, "/proc/%d/fd/%d%s%s", getpid(), folder, *copy ? "/" : "", copy);
        if (check(full))
            return -1;
    } else if (check(path))
        return -1;
    return REAL(syscall)(SYS_execveat, folder, path, arguments, environment, flags);
}

int fexecve(int fd, char *const *arguments, char *const *environment) {
    return execveat(fd, "", arguments, environment, AT_EMPTY_PATH);
}

#define DEFINE_SPAWN(name, find)                                                                             \
    int name(pid_t *child, const char *path, const posix_spawn_file_actions_t *actions,                      \
             const posix_spawnattr_t *attributes, char *const *arguments, char *const *environment) {        \
        char buffer[PATH_MAX];                                                                               \
        COMPLETE(environment);                                                                               \
        (void)buffer;                                                                                        \
        return check(find) ? errno : REAL(name)(child, path, actions, attributes, arguments, environment);   \
    }
DEFINE_SPAWN(posix_spawn, path)
DEFINE_SPAWN(posix_spawnp, find_program(path, buffer))

/* Functions that start a shell inside the C library, with the environment of the program. */
#define DEFINE_SHELL(type, name, parameters, arguments)                                                      \
    type name parameters {                                                                                   \
        char **saved = environ;                                                                              \
        char *const *entries = environ;                                                                      \
        COMPLETE(entries);                                                                                   \
        if (entries != saved)                                                                                \
            environ = completed;                                                                             \
        type result = REAL(name) arguments;                                                                  \
        if (environ == completed)                                                                            \
            environ = saved;                                                                                 \
        return result;                                                                                       \
    }
DEFINE_SHELL(int, system, (const char *command), (command))
DEFINE_SHELL(FILE *, popen, (const char *command, const char *mode), (command, mode))
