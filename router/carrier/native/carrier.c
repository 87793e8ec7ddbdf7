/* The carrier's threads: start, stop, and what other threads ask of them. */
#include "carrier_internal.h"

#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "clock.h"

static const int64_t PYTHON_TIMEOUT = 30000000000; /* ns for which the watchdog is fed while Python is stuck */
static const char ALIVE[] = "WATCHDOG=1";

struct carrier *carrier_open(struct timers *timers, counter *counters, struct ring *events, struct ring *published) {
    struct carrier *carrier = calloc(1, sizeof *carrier);
    if (!carrier) return NULL;
    bool is_open = stage_open(&carrier->routing.stage, counters, events, timers);
    carrier->routing.published = published;
    carrier->notify = -1;
    carrier->epoll = epoll_create1(EPOLL_CLOEXEC);
    carrier->wake = eventfd(0, EFD_CLOEXEC);
    if (!is_open || carrier->epoll < 0 || carrier->wake < 0) {
        carrier_close(carrier);
        return NULL;
    }
    return carrier;
}

int carrier_start(struct carrier *carrier, const struct change *first) {
    carrier_pulse(carrier);
    carrier_adopt_first(carrier, first);
    int error = start_thread(&carrier->timing, "timers", timer_thread, carrier);
    if (error) return error;
    error = start_thread(&carrier->receiving, "receive", receive_thread, carrier);
    carrier->has_started = true;
    carrier->has_stopped = error != 0;
    return error;
}

void carrier_change(struct carrier *carrier, const struct change *change) {
    atomic_store(&carrier->adopted, NULL);
    atomic_store(&carrier->next, change);
    while (atomic_load(&carrier->adopted) != change) usleep(200);
}

void carrier_mirror(struct carrier *carrier, struct ring *mirror, uint32_t lost) {
    atomic_store_explicit(&carrier->mirror_lost, lost, memory_order_relaxed);
    atomic_store_explicit(&carrier->mirror, mirror, memory_order_release);
}

void carrier_pulse(struct carrier *carrier) { atomic_store(&carrier->pulse, monotonic_ns()); }

uint64_t carrier_turns(struct carrier *carrier) { return atomic_load_explicit(&carrier->turns, memory_order_acquire); }

/* Feed the service manager's watchdog while receiving makes progress and Python does something now and then. */
static void feed_watchdog(struct carrier *carrier) {
    uint64_t turns = carrier_turns(carrier);
    if (turns == carrier->turns_seen || monotonic_ns() - atomic_load(&carrier->pulse) > PYTHON_TIMEOUT) return;
    carrier->turns_seen = turns;
    send(atomic_load(&carrier->notify), ALIVE, sizeof ALIVE - 1, MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* Return how long to wait for the watchdog's next turn, in ms for `poll`. */
static int until_turn(struct carrier *carrier, int64_t turn) {
    if (atomic_load(&carrier->notify) < 0) return -1;
    int64_t wait = turn - monotonic_ns();
    return wait > 0 ? (int)(wait / 1000000) + 1 : 0;
}

/* Serves what is due when nothing is received, and the watchdog. */
void *timer_thread(void *of) {
    struct carrier *carrier = of;
    int64_t turn = 0;
    run_first();
    while (!atomic_load(&carrier->is_closing)) {
        struct pollfd waiting[] = {{carrier->routing.stage.timers->timer, POLLIN, 0}, {carrier->wake, POLLIN, 0}};
        poll(waiting, 2, until_turn(carrier, turn));
        eventfd_t ignored;
        if (waiting[1].revents) eventfd_read(carrier->wake, &ignored);
        if (waiting[0].revents) timers_serve(carrier->routing.stage.timers, boottime_ns());
        if (atomic_load(&carrier->notify) >= 0 && monotonic_ns() >= turn) {
            feed_watchdog(carrier);
            turn = monotonic_ns() + atomic_load(&carrier->interval);
        }
    }
    return NULL;
}

void carrier_watchdog(struct carrier *carrier, int notify, int64_t interval) {
    atomic_store(&carrier->interval, interval);
    atomic_store(&carrier->notify, notify);
    eventfd_write(carrier->wake, 1);
}

bool carrier_counters(struct carrier *carrier, int64_t *to, uint32_t count) {
    return counters_copy(&carrier->edition, carrier->routing.stage.counters, to, count);
}

void carrier_stop_receiving(struct carrier *carrier) {
    if (!carrier->has_started || carrier->has_stopped) return;
    atomic_store(&carrier->is_stopping, true);
    pthread_join(carrier->receiving, NULL);
    carrier->has_stopped = true;
}

void carrier_close(struct carrier *carrier) {
    carrier_stop_receiving(carrier);
    if (carrier->has_started) {
        atomic_store(&carrier->is_closing, true);
        eventfd_write(carrier->wake, 1);
        pthread_join(carrier->timing, NULL);
    }
    if (carrier->epoll >= 0) close(carrier->epoll);
    if (carrier->wake >= 0) close(carrier->wake);
    stage_close(&carrier->routing.stage);
    free(carrier);
}
