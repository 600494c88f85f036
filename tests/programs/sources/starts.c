/* Children that are started in all ways, with an environment that lacks the twin's variables. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static const char *self;
static char *none[] = {"PATH=/usr/bin:/bin", NULL};

static void start(const char *how) {
    char *words[] = {"child", (char *)how, NULL}, command[512];
    pid_t child;
    snprintf(command, sizeof command, "%s %s", self, how);
    if (!strcmp(how, "execv"))
        execv(self, words);
    else if (!strcmp(how, "execve"))
        execve(self, words, none);
    else if (!strcmp(how, "execvp"))
        execvp(self, words);
    else if (!strcmp(how, "execvpe"))
        execvpe(self, words, none);
    else if (!strcmp(how, "execl"))
        execl(self, "child", how, NULL);
    else if (!strcmp(how, "execlp"))
        execlp(self, "child", how, NULL);
    else if (!strcmp(how, "execle"))
        execle(self, "child", how, NULL, none);
    else if (!strcmp(how, "fexecve"))
        fexecve(open(self, O_RDONLY), words, none);
    else if (!strcmp(how, "execveat"))
        execveat(AT_FDCWD, self, words, none, 0);
    else if (!strcmp(how, "syscall"))
        syscall(SYS_execve, self, words, none);
    else if (!strcmp(how, "spawn") && !posix_spawn(&child, self, NULL, NULL, words, none))
        waitpid(child, NULL, 0);
    else if (!strcmp(how, "spawnp") && !posix_spawnp(&child, self, NULL, NULL, words, none))
        waitpid(child, NULL, 0);
    else if (!strcmp(how, "system"))
        _exit(system(command) != 0);
    else if (!strcmp(how, "popen"))
        pclose(popen(command, "w"));
    else
        _exit(1);
    _exit(0);
}

int main(int count, char **words) {
    static const char *const ways[] = {"execv", "execve", "execvp", "execvpe", "execl", "execlp", "execle",
                                       "fexecve", "execveat", "syscall", "spawn", "spawnp", "system", "popen"};
    time_t seconds = time(NULL);
    if (count > 1) {
        printf("%s %d %s\n", words[1], 1900 + gmtime(&seconds)->tm_year, getenv("OTHER") ? "" : "alone");
        return 0;
    }
    setenv("OTHER", "1", 1);
    clearenv();
    self = words[0];
    for (size_t i = 0; i < sizeof ways / sizeof *ways; i++) {
        if (!fork())
            start(ways[i]);
        wait(NULL);
    }
    return 0;
}
