/* Deferrals and pacers without threads, sockets and clocks: what would leave is written down. A library of its own, which
 * uses that of the carrier. */
#include "defer.h"
#include "earliest.h"

#include <malloc.h>
#include <stdlib.h>
#include <string.h>

enum { GONE = 0xa5 }; /* bytes of what nothing may use any more */
enum { MOST_TARGETS = 256, COUNTERS = 32 };

/* What has left, or would have if it had not been refused. The bytes follow. */
struct noted {
    uint32_t size, target;
    int64_t at;
    uint32_t length, reserved;
};

/* One thread that offers, a group of timers, and their targets. Counters of target N begin at N * COUNTERS. */
struct deferring {
    struct thread_env offering, sending;
    struct timers *timers;
    counter counters[MOST_TARGETS * COUNTERS];
    struct topic topic;
    struct targets to;
    struct target targets[MOST_TARGETS];
    struct deferral *deferrals[MOST_TARGETS]; /* theirs */
    struct output notes;
    int64_t now;
    int error; /* that sending returns */
    bool is_given_up; /* the thread is when it publishes next */
};

struct deferring *seam_open(void);
void seam_close(struct deferring *of);
uint32_t seam_target(struct deferring *of, struct deferral *deferral, int64_t period, uint32_t priority, bool is_topic);
void seam_offer(struct deferring *of, uint32_t number, const void *data, size_t size, int64_t expires, int64_t now);
void seam_offer_written(struct deferring *of, uint32_t number, const void *data, size_t size, int64_t expires, int64_t now);
void seam_adopt(struct deferring *of, struct timer *timer, uint32_t number);
void seam_end(struct deferring *of, struct timer *timer);
void seam_end_all(struct deferring *of);
void seam_set(struct deferring *of, int64_t now, int error);
void seam_give_up(struct deferring *of);
bool seam_is_untouched(struct deferring *of);
void seam_give_up(struct deferring *of) { of->is_given_up = true; }

/* Whether nobody has used a deferral since. */
bool seam_is_untouched(struct deferring *of) {
    for (uint32_t number = 0; number < of->to.count; number++) {
        const uint8_t *deferral = (const uint8_t *)of->deferrals[number];
        for (size_t at = 0; at < malloc_usable_size(of->deferrals[number]); at++)
            if (deferral[at] != GONE) return false;
    }
    return true;
}

void seam_serve(struct deferring *of, int64_t now);
int64_t seam_next_due(struct deferring *of);
int64_t seam_count(struct deferring *of, uint32_t number, uint32_t which);
size_t seam_taken(struct deferring *of, const void **notes);

static struct deferring *opened; /* for functions of the envs, which are one after the other */

static int64_t now_of(struct thread_env *env) {
    (void)env;
    return opened->now;
}

static int note(const struct target *target, const uint8_t *data, size_t size) {
    static const uint8_t zeros[8];
    struct noted noted = {.size = (uint32_t)(sizeof noted + (size + 7) / 8 * 8), .target = (uint32_t)(target - opened->targets),
                          .at = opened->now, .length = (uint32_t)size};
    if (opened->error) return opened->error;
    if (!append(&opened->notes, &noted, sizeof noted) || !append(&opened->notes, data, size) ||
        !append(&opened->notes, zeros, noted.size - sizeof noted - size))
        abort();
    return 0;
}

static int send_noted(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    (void)env;
    return opened->now > expires ? COMMAND_STALE : note(target, data, size);
}

/* As the thread is given up in the middleware: the owner of what it serves frees that. */
static void give_up(void) {
    for (uint32_t number = 0; number < opened->to.count; number++) {
        struct deferral *deferral = opened->deferrals[number];
        memset(deferral, GONE, malloc_usable_size(deferral));
    }
}

static enum publication publish_noted(struct thread_env *env, const struct targets *to, const struct target *target,
                                      const char **why) {
    (void)to;
    *why = "refused";
    if (opened->is_given_up) {
        give_up();
        return ABANDONED;
    }
    return note(target, env->machine.output.data, env->machine.output.size) ? PUBLISH_FAILED : PUBLISHED;
}

static void open_env(struct deferring *of, struct thread_env *env) {
    if (!env_open(env, of->counters, ring_open(1 << 12), NULL)) abort();
    env->now = now_of;
    env->send = send_noted;
    env->publish = publish_noted;
}

struct deferring *seam_open(void) {
    struct deferring *made = calloc(1, sizeof *made);
    if (!made) abort();
    open_env(made, &made->offering);
    open_env(made, &made->sending);
    made->timers = timers_open_on(&made->sending, false);
    if (!made->timers) abort();
    made->offering.timers = made->sending.timers = made->timers;
    made->to.targets = made->targets;
    opened = made;
    return made;
}

void seam_close(struct deferring *of) {
    timers_close(of->timers);
    ring_close(of->offering.reporter.events);
    ring_close(of->sending.reporter.events);
    env_close(&of->offering);
    env_close(&of->sending);
    free(of->notes.data);
    free(of);
}

/* Add a target, and have its deferral deliver to it. Return its number. */
uint32_t seam_target(struct deferring *of, struct deferral *deferral, int64_t period, uint32_t priority, bool is_topic) {
    uint32_t number = of->to.count++, first = number * COUNTERS;
    struct target *made = &of->targets[number];
    of->deferrals[number] = deferral;
    *made = (struct target){.period = period, .priority = priority, .delivered = first,
                            .delivered_bytes = first + 1, .topic = is_topic ? &of->topic : NULL};
    for (uint32_t reason = 0; reason < DROP_REASONS; reason++) made->dropped[reason] = first + 2 + reason;
    if (deferral) seam_adopt(of, (struct timer *)deferral, number);
    return number;
}

void seam_adopt(struct deferring *of, struct timer *timer, uint32_t number) {
    struct adoption adoption = {timer, &of->to, &of->targets[number]};
    timers_change(of->timers, &(struct timer_change){.adopted = &adoption, .adopted_count = 1});
}

void seam_end(struct deferring *of, struct timer *timer) {
    timers_change(of->timers, &(struct timer_change){.ended = &timer, .ended_count = 1});
}

void seam_end_all(struct deferring *of) { timers_end(of->timers); }

void seam_set(struct deferring *of, int64_t now, int error) {
    of->now = now;
    of->error = error;
}

void seam_serve(struct deferring *of, int64_t now) { timers_serve(of->timers, now); }

int64_t seam_next_due(struct deferring *of) { return earliest(of->timers); }

int64_t seam_count(struct deferring *of, uint32_t number, uint32_t which) {
    return of->counters[number * COUNTERS + which];
}

/* A datagram of which a sanitizer sees what is read behind it. */
void seam_offer(struct deferring *of, uint32_t number, const void *data, size_t size, int64_t expires, int64_t now) {
    uint8_t *copy = malloc(size ? size : 1);
    if (!copy) abort();
    if (size) memcpy(copy, data, size);
    if (!defer(&of->offering, of->deferrals[number], copy, size, expires, now)) abort();
    free(copy);
}

/* What a machine has written: that of the thread which publishes, for a topic. */
void seam_offer_written(struct deferring *of, uint32_t number, const void *data, size_t size, int64_t expires, int64_t now) {
    struct thread_env *env = of->targets[number].topic ? &of->sending : &of->offering;
    env->machine.output.size = 0;
    if (!append(&env->machine.output, data, size)) abort();
    if (!defer(env, of->deferrals[number], env->machine.output.data, size, expires, now)) abort();
}

/* What has left since the last call. */
size_t seam_taken(struct deferring *of, const void **notes) {
    size_t size = of->notes.size;
    *notes = of->notes.data;
    of->notes.size = 0;
    return size;
}
