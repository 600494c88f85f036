/* Four threads at one lock, one condition and one pipe, and who gets them, without a wait for a time. */
#include <pthread.h>
#include <stdio.h>
#include <unistd.h>

static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t condition = PTHREAD_COND_INITIALIZER;
static pthread_barrier_t barrier;
static char order[2000];
static int portions, used, ends[2];
static volatile int counted;

static void compute(int count) {
    for (int i = 0; i < count; i++)
        counted += i;
}

static void note(char letter) {
    pthread_mutex_lock(&mutex);
    order[used++] = letter;
    pthread_mutex_unlock(&mutex);
}

static void *take(void *given) {
    char number = (char)(long)given, none;
    for (int i = 0; i < 20; i++) {
        pthread_mutex_lock(&mutex);
        while (!portions)
            pthread_cond_wait(&condition, &mutex);
        portions--;
        order[used++] = '0' + number;
        compute(1000 * number);
        pthread_cond_signal(&condition);
        pthread_mutex_unlock(&mutex);
        compute(500);
    }
    pthread_barrier_wait(&barrier);
    note('a' + number);
    for (int i = 0; i < 10; i++)
        if (read(ends[0], &none, 1) == 1)
            note('A' + number);
    return NULL;
}

int main(void) {
    pthread_t threads[4];
    if (pipe(ends))
        return 1;
    pthread_barrier_init(&barrier, NULL, 4);
    for (long i = 0; i < 4; i++)
        pthread_create(&threads[i], NULL, take, (void *)i);
    for (int i = 0; i < 80; i++) {
        pthread_mutex_lock(&mutex);
        portions++;
        order[used++] = '+';
        pthread_cond_broadcast(&condition);
        pthread_mutex_unlock(&mutex);
        compute(2000);
        if (i % 10 == 0)
            usleep(1000);
    }
    for (int i = 0; i < 40; i++)
        if (write(ends[1], "x", 1) == 1)
            compute(1000);
    for (int i = 0; i < 4; i++)
        pthread_join(threads[i], NULL);
    puts(order);
    return 0;
}
