/* Program of a khep_twin network: cc -o NAME NAME.c -lm */
#include <math.h>
#include <signal.h>
#include <sys/timerfd.h>
#include <unistd.h>

/* tables */

static volatile sig_atomic_t is_ended;
static double neurons[N_NEURONS], memory[N_NEURONS];

static void end(int number) { is_ended = number; }

int main(void) {
    const struct itimerspec period = {PERIOD, PERIOD};
    int timer = timerfd_create(CLOCK_MONOTONIC, 0), readings[N_INPUTS], layer, neuron, i;
    unsigned long long n_periods;
    signal(SIGHUP, end), signal(SIGINT, end), signal(SIGTERM, end);
    start();
    timerfd_settime(timer, 0, &period, NULL);
    do {
        const double *gene = GENES, *scale = SCALES;
        double *input = neurons, *output = neurons + N_INPUTS;
        read_registers(readings);
        for (i = 0; i < N_INPUTS; i++, scale += 4) /* lowest, highest, and those that are 0 and 1 */
            input[i] = (fmin(fmax(readings[i], scale[0]), scale[1]) - scale[2]) / (scale[3] - scale[2]);
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
        drive(lrint(TOP_SPEED * input[0]), lrint(TOP_SPEED * input[1]));
    } while (read(timer, &n_periods, sizeof n_periods) > 0 && !is_ended);
    drive(0, 0);
    return 0;
}
