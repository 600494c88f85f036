/* What the clocks say, and what looks at them. */
#include <stdio.h>
#include <sys/time.h>
#include <sys/times.h>
#include <time.h>
#include <unistd.h>

int main(void) {
    char text[32];
    struct timespec steady, dated, end;
    struct timeval day;
    time_t now = time(NULL);
    strftime(text, sizeof text, "%Y-%m-%d %H:%M:%S", gmtime(&now));
    puts(text);
    clock_gettime(CLOCK_MONOTONIC, &end);
    end.tv_sec += 10;
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &end, NULL);
    clock_gettime(CLOCK_MONOTONIC, &steady);
    clock_gettime(CLOCK_REALTIME, &dated);
    gettimeofday(&day, NULL);
    printf("%ld %ld %ld\n", (long)steady.tv_sec, (long)(dated.tv_sec - now), (long)(day.tv_sec - now));
    printf("%ld %d\n", (long)clock() / CLOCKS_PER_SEC, (int)(times(&(struct tms){0}) / sysconf(_SC_CLK_TCK)));
    for (clock_t since = clock(); clock() < since + CLOCKS_PER_SEC / 100;)
        ;
    clock_gettime(CLOCK_MONOTONIC, &end);
    printf("%.4f\n", end.tv_sec - steady.tv_sec + (end.tv_nsec - steady.tv_nsec) / 1e9);
    return 0;
}
