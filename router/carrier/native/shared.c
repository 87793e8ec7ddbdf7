/* What the threads of the carrier have in common. */
#include "carrier_internal.h"

#include <signal.h>

#include "clock.h"

/* ---- threads ---- */

int start_thread(pthread_t *thread, const char *name, void *(*run)(void *), void *argument) {
    sigset_t all, usual;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &usual);
    int error = pthread_create(thread, NULL, run, argument);
    pthread_sigmask(SIG_SETMASK, &usual, NULL);
    if (!error) pthread_setname_np(*thread, name);
    return error;
}

static const int64_t PATIENCE = 1000000000;

struct timespec patience(void) {
    int64_t until = monotonic_ns() + PATIENCE;
    return (struct timespec){until / 1000000000, until % 1000000000};
}

void condition_open(pthread_cond_t *condition) {
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(condition, &attributes);
    pthread_condattr_destroy(&attributes);
}

/* ---- counting ---- */

/* HISTOGRAM_BOUNDS_NS in compiler/metrics.py; a cell for what is slower and one for the sum follow. */
enum { HISTOGRAM_BOUNDS = 12 };
static const int64_t BOUNDS[HISTOGRAM_BOUNDS] = {10000,   20000,   50000,   100000,   200000,   500000,
                                                 1000000, 2000000, 5000000, 10000000, 20000000, 50000000};

static uint32_t histogram_cell(int64_t elapsed) {
    uint32_t cell = 0;
    while (cell < HISTOGRAM_BOUNDS && elapsed > BOUNDS[cell]) cell++;
    return cell;
}

void count_duration(counter *counters, uint32_t histogram, int64_t elapsed) {
    counter_add(counters, histogram + histogram_cell(elapsed), 1);
    counter_add(counters, histogram + HISTOGRAM_BOUNDS + 1, elapsed);
}
