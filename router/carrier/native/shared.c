/* What the threads of the carrier have in common. */
#include "carrier_internal.h"

#include <errno.h>
#include <signal.h>
#include <string.h>
#include <unistd.h>

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

/* ---- counting and reporting ---- */

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

enum { MOST_EVENTS = 32 }; /* per EVENT_WINDOW: a flood is counted, not reported */
static const int64_t EVENT_WINDOW = 10000000;

bool may_report(struct reporter *reporter, int64_t now) {
    if (now - reporter->window_began > EVENT_WINDOW) {
        reporter->window_began = now;
        reporter->left = MOST_EVENTS;
    }
    if (!reporter->left) return false;
    reporter->left--;
    return true;
}

void report_loss(struct reporter *reporter, int64_t now, uint32_t route, uint32_t target, enum loss reason, int error,
                 uint32_t counted) {
    struct lost_event event = {sizeof event, EVENT_LOST, route, target, reason, error, counted, 0, 0};
    if (may_report(reporter, now)) ring_put(reporter->events, &event, sizeof event);
}

void report_loss_because(struct reporter *reporter, int64_t now, const struct lost_event *lost, const char *text) {
    enum { LONGEST = 255 };
    struct {
        struct lost_event event;
        char text[LONGEST + 1];
    } record = {.event = *lost};
    size_t length = strnlen(text, LONGEST);
    memcpy(record.text, text, length);
    record.event.kind = EVENT_LOST;
    record.event.size = (uint32_t)(sizeof record.event + (length + 8) / 8 * 8);
    if (may_report(reporter, now)) ring_put(reporter->events, &record, record.event.size);
}

/* ---- destinations ---- */

bool destination_may_send(counter *counters, const struct destination *to, int64_t now, int64_t expires) {
    if (expires != NEVER && boottime_ns() > expires) {
        counter_add(counters, to->stale, 1);
        return false;
    }
    if (to->limit && !limit_passes(to->limit, now)) {
        counter_add(counters, to->rate_limited, 1);
        return false;
    }
    return true;
}

bool destination_takes(counter *counters, struct reporter *reporter, int64_t now, uint32_t route,
                       const struct destination *to, const uint8_t *data, size_t size) {
    struct board_refusal refusal;
    if (!to->board || board_takes(to->board, data, size, &refusal)) return true;
    uint32_t counted = refusal.reason == LOSS_TOO_LARGE ? to->too_large : to->non_finite;
    counter_add(counters, counted, 1);
    struct lost_event lost = {.route = route, .target = to->id, .reason = refusal.reason, .counter = counted};
    report_loss_because(reporter, now, &lost, refusal.text);
    return false;
}

/* The size of an envelope without its trailing zeros, if it can be told from the rest how many there were. */
static size_t trimmed_size(const uint8_t *data, size_t size) {
    size_t trimmed = size;
    while (trimmed && !data[trimmed - 1]) trimmed--;
    return envelope_restored_size(data, trimmed) == size ? trimmed : size;
}

static enum loss loss_of(int error) {
    bool is_full = error == EAGAIN || error == EWOULDBLOCK || error == ENOBUFS;
    return is_full ? LOSS_SEND_BUFFER_FULL : LOSS_SEND_ERROR;
}

static uint32_t counter_of(const struct destination *to, enum loss reason) {
    return reason == LOSS_SEND_ERROR ? to->send_error : to->send_buffer_full;
}

int destination_send(struct deadmen *deadmen, counter *counters, const struct destination *to, const uint8_t *data,
                     size_t size, int64_t expires) {
    if (to->trims) size = trimmed_size(data, size);
    int error = command_send(deadmen, to->sender, data, size, expires, to->feeds, to->feed_count);
    if (!error) {
        counter_add(counters, to->sent, 1);
        counter_add(counters, to->sent_bytes, (int64_t)size);
    } else if (error == COMMAND_STALE) {
        counter_add(counters, to->stale, 1);
    } else {
        counter_add(counters, counter_of(to, loss_of(error)), 1);
    }
    return error;
}

void report_send_error(struct reporter *reporter, int64_t now, uint32_t route, const struct destination *to, int error) {
    enum loss reason = loss_of(error);
    report_loss(reporter, now, route, to->id, reason, error, counter_of(to, reason));
}
