/* Program of a khep_twin network: cc -o NAME NAME.c -lm */
#define _GNU_SOURCE
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <time.h>

/* tables */

static volatile sig_atomic_t is_ended;
static double neurons[N_NEURONS], memory[N_NEURONS];

static void end(int number) { is_ended = number; }

static long long time_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

/* Evaluate the network; return its outputs. */
static const double *forward(void) {
    const double *gene = GENES;
    double *input = neurons, *output = neurons + N_INPUTS;
    int layer, neuron, i;
    for (i = 0; i < N_FEEDBACK; i++)
        memory[i] = output[i];
    for (layer = 1; layer < N_LAYERS; input = output, output += SIZES[layer++])
        for (neuron = 0; neuron < SIZES[layer]; neuron++) {
            double total = *gene++;
            for (i = 0; i < SIZES[layer - 1]; i++)
                total += *gene++ * input[i];
            for (i = 0; i < N_FEEDBACK && layer == 1; i++)
                total += *gene++ * memory[i];
            output[neuron] = 1 - 2 / (1 + exp(2 * (total > 20 ? 20 : total)));
        }
    return input;
}

int main(void) {
    int i, readings[N_INPUTS], n_cycles, n_late = 0;
    long long end_ns;
    signal(SIGHUP, end), signal(SIGINT, end), signal(SIGTERM, end);
    start();
    end_ns = time_ns();
    for (n_cycles = 0; !is_ended; n_cycles++) {
        const double *outputs, *scale = SCALES;
        struct timespec until;
        read_registers(readings);
        for (i = 0; i < N_INPUTS; i++, scale += 4) /* lowest, highest, 0 and 1 of the input */
            neurons[i] = (fmin(fmax(readings[i], scale[0]), scale[1]) - scale[2]) / (scale[3] - scale[2]);
        outputs = forward();
        drive(lrint(TOP_SPEED * outputs[0]), lrint(TOP_SPEED * outputs[1]));
        end_ns += PERIOD_NS;
        if (time_ns() > end_ns)
            n_late++, end_ns = time_ns();
        until.tv_sec = end_ns / 1000000000, until.tv_nsec = end_ns % 1000000000;
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
    }
    drive(0, 0);
    printf("%d cycles, %d of them late\n", n_cycles, n_late);
    return 0;
}
