#include "deadman.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "defer.h"
#include "deliver.h"

/* In ns: the delay before the datagrams of the start are sent again; how long after the start a newly discovered
 * subscriber may be one that already existed, as discovery takes less; and the time in which it also discovers the
 * publisher. */
static const int64_t START_AGAIN = 1000000000, START = 10000000000, GREETING = 500000000;

/* ns from one message that is reported as evidence to the next. */
static const int64_t EVIDENCE = 1000000000;

/* What a destination has shown since the deadman tripped. */
struct answer {
    int64_t owed_since;  /* it must show within `within` from here that it obeys; NEVER while it does, 0: not awaited */
    int64_t evidence_at; /* when evidence may be reported next */
    bool is_timed;       /* its stopping time is counted */
    bool disobeys;
};

struct deadman {
    struct timer timer;      /* not due while unarmed, and never once replaced */
    struct timer starting;   /* due while `unstarted` */
    struct deadman *acting;  /* the last deadman that has replaced it, or itself */
    struct deadman *fellow;  /* the next one with the same `acting`, in a circular list */
    int64_t timeout, repeat; /* ns */
    /* Destinations, a bit for each: */
    uint64_t armed;          /* get datagrams when it trips, and when it ends */
    uint64_t followers;
    uint64_t own;            /* all, without those that have passed to the deadman that has replaced it */
    uint64_t unstarted;      /* get the datagrams of the start when `starting` is served next */
    uint64_t started;        /* have got the datagrams of the start */
    uint64_t watched;        /* may show whether they obey */
    bool has_tripped;        /* written by `set_tripped` */
    bool starts;             /* sends when the router starts */
    bool is_ending;          /* ends when it is served next */
    int64_t tripped_at;      /* while tripped: since when */
    int64_t greets_until;    /* until then, and while unarmed, it greets new subscribers */
    int64_t greets_again;    /* the due time of `starting` after the next one; or NEVER */
    uint32_t active, trips, id;
    uint32_t count;
    struct answer *answers; /* of the destinations */
    int64_t *heard_at;      /* when each was last heard before the first datagrams of the start */
    struct deadman_destination destinations[];
};

/* The functions up to the public ones are called with the lock held. */

/* Report an event without a limit: if there is no room, drop the oldest event. */
static void report_event(struct timers *timers, void *event, size_t size, const char *text) {
    struct event_head oldest;
    struct ring *events = timers->env->reporter.events;
    if (!events) return;
    while (!put_event(events, event, size, text)) ring_drop(events, &oldest, sizeof oldest);
}

static void report_with(struct timers *timers, struct deadman_event event, const char *why) {
    report_event(timers, &event, sizeof event, why);
}

static void report(struct timers *timers, enum event_kind kind, const struct deadman *deadman) {
    report_with(timers, (struct deadman_event){.kind = kind, .deadman = deadman->id}, "");
}

/* Report that a datagram failed: `error` is an errno, or 0 and `why` is the reason. */
static void report_error(struct timers *timers, const struct deadman *deadman, const struct deadman_destination *to,
                         int error, const char *why) {
    report_with(timers, (struct deadman_event){0, EVENT_DEADMAN_ERROR, deadman->id, to->id, error, to->send_errors}, why);
}

static void note(struct timers *timers, enum action action, const struct deadman *deadman) {
    struct actions *observed = atomic_load_explicit(&timers->actions, memory_order_acquire);
    struct action_record record = {.action = action, .route = deadman->id, .target = NO_NAME, .topic = NO_NAME};
    if (observed) actions_note(observed, timers->env->counters, record, NULL, 0);
}

static void note_brake(struct timers *timers, const struct deadman *deadman, const struct deadman_destination *to,
                       const struct deadman_datagram *datagram, int error) {
    struct actions *observed = atomic_load_explicit(&timers->actions, memory_order_acquire);
    struct action_record record = {.action = ACTION_BRAKED, .route = deadman->id, .target = to->id, .topic = NO_NAME,
                                   .error = error};
    if (observed) actions_note(observed, timers->env->counters, record, datagram->data, datagram->size);
}

/* Send the datagrams for a destination. Return 0, BRAKE_LATER, or the last error. */
static int send_to(struct timers *timers, struct deadman *deadman, const struct deadman_destination *to) {
    int failed = 0;
    for (uint32_t index = 0; index < to->count; index++) {
        if (to->beside.count) beside_fill(&to->beside, to->datagrams[index].data, timers->env->wall(timers->env));
        int error = timers->env->brake(timers->env, to, &to->datagrams[index]);
        if (error) failed = error;
        if (error == BRAKE_LATER) continue;
        note_brake(timers, deadman, to, &to->datagrams[index], error);
        env_count(timers->env, error ? to->send_errors : to->sent, 1);
        if (error) report_error(timers, deadman, to, error, "");
    }
    return failed;
}

struct outcome {
    uint64_t reached, failed;
};

/* Send to destinations. A refused datagram has not failed: a receiver that refuses it does not execute earlier commands
 * either. */
static struct outcome send_all(struct timers *timers, struct deadman *deadman, uint64_t destinations) {
    struct outcome outcome = {0};
    for (uint64_t left = destinations; left; left &= left - 1) {
        int error = send_to(timers, deadman, &deadman->destinations[__builtin_ctzll(left)]);
        if (!error) outcome.reached |= left & -left;
        else if (error != BRAKE_LATER && error != ECONNREFUSED) outcome.failed |= left & -left;
    }
    return outcome;
}

/* ---- answers ---- */

static void report_answer(struct timers *timers, const struct deadman *deadman, enum event_kind kind, uint32_t destination,
                          int64_t after) {
    struct answer_event event = {.size = sizeof event, .kind = kind, .deadman = deadman->id, .destination = destination,
                                 .after = after};
    report_event(timers, &event, sizeof event, "");
}

static void set_disobeys(struct timers *timers, struct deadman *deadman, uint32_t index, bool disobeys) {
    if (deadman->answers[index].disobeys == disobeys) return;
    deadman->answers[index].disobeys = disobeys;
    counter_set(timers->env->counters, deadman->destinations[index].disobeyed, disobeys);
}

/* Await answers of destinations from `now` on; 0: no longer. */
static void await_answers(struct timers *timers, struct deadman *deadman, uint64_t destinations, int64_t now) {
    for (uint64_t left = destinations & deadman->watched; left; left &= left - 1) {
        uint32_t index = (uint32_t)__builtin_ctzll(left);
        set_disobeys(timers, deadman, index, false);
        deadman->answers[index] = (struct answer){.owed_since = now};
    }
}

static void check_answers(struct timers *timers, struct deadman *deadman, int64_t now) {
    for (uint64_t left = deadman->watched; left; left &= left - 1) {
        uint32_t index = (uint32_t)__builtin_ctzll(left);
        const struct deadman_destination *to = &deadman->destinations[index];
        const struct answer *answer = &deadman->answers[index];
        bool is_owed = answer->owed_since && answer->owed_since != NEVER && !answer->disobeys;
        if (!is_owed || now - answer->owed_since < to->within) continue;
        set_disobeys(timers, deadman, index, true);
        report_answer(timers, deadman, EVENT_DISOBEYED, to->id, now - deadman->tripped_at);
    }
}

static void take_obedience(struct timers *timers, struct deadman *deadman, uint32_t index, int64_t arrived) {
    struct answer *answer = &deadman->answers[index];
    const struct deadman_destination *to = &deadman->destinations[index];
    int64_t after = arrived - deadman->tripped_at;
    if (!answer->is_timed) count_duration(timers->env->counters, to->stopping, STOPPING, after);
    if (!answer->is_timed || answer->disobeys) report_answer(timers, deadman, EVENT_OBEYED, to->id, after);
    set_disobeys(timers, deadman, index, false);
    answer->is_timed = true;
    answer->owed_since = NEVER;
}

static bool take_disobedience(struct deadman *deadman, uint32_t index, int64_t arrived) {
    struct answer *answer = &deadman->answers[index];
    if (answer->owed_since == NEVER) answer->owed_since = arrived;
    if (arrived < answer->evidence_at) return false;
    answer->evidence_at = arrived + EVIDENCE;
    return true;
}

/* ---- arming ---- */

static void set_tripped(struct deadman *deadman, bool is_tripped) {
    __atomic_store_n(&deadman->has_tripped, is_tripped, __ATOMIC_RELAXED);
}

static void release(struct timers *timers, struct deadman *deadman) {
    if (!deadman->has_tripped) return;
    set_tripped(deadman, false);
    await_answers(timers, deadman, deadman->own, 0);
    counter_set(timers->env->counters, deadman->active, 0);
    report(timers, EVENT_RELEASED, deadman);
    note(timers, ACTION_RELEASED, deadman);
}

static void end_start(struct timers *timers, struct deadman *deadman, uint64_t destinations) {
    deadman->unstarted &= ~destinations;
    if (!deadman->unstarted) timer_set_due(timers, &deadman->starting, NEVER);
}

static void arm(struct timers *timers, struct deadman *deadman, uint64_t to, int64_t now) {
    to |= deadman->followers;
    end_start(timers, deadman, to);
    deadman->armed |= to;
    timer_set_due(timers, &deadman->timer, now + deadman->timeout);
    release(timers, deadman);
}

/* Destinations that stay armed keep the deadline. */
static void disarm(struct timers *timers, struct deadman *deadman, uint64_t to) {
    end_start(timers, deadman, to);
    deadman->armed &= ~to;
    await_answers(timers, deadman, to, 0);
    if (deadman->armed & ~deadman->followers) return;
    deadman->armed = 0;
    timer_set_due(timers, &deadman->timer, NEVER);
    release(timers, deadman);
}

static uint64_t bit(uint32_t index) { return (uint64_t)1 << index; }

/* Return the destinations with this name. */
static uint64_t named(const struct deadman *deadman, uint32_t id) {
    uint64_t found = 0;
    for (uint32_t index = 0; index < deadman->count; index++)
        if (deadman->destinations[index].id == id) found |= bit(index);
    return found;
}

/* Return the destinations with this sender. */
static uint64_t placed(const struct deadman *deadman, const struct sender *sender) {
    uint64_t found = 0;
    for (uint32_t index = 0; index < deadman->count; index++)
        if (deadman->destinations[index].sender == sender) found |= bit(index);
    return found;
}

/* Return the destinations of `next` that have the names of these. */
static uint64_t renumbered(const struct deadman *next, const struct deadman *earlier, uint64_t destinations) {
    uint64_t found = 0;
    for (uint64_t left = destinations; left; left &= left - 1)
        found |= named(next, earlier->destinations[__builtin_ctzll(left)].id);
    return found;
}

/* Return the destinations that a feed of a deadman that was replaced has in the acting one. Arm or disarm those that only
 * replaced ones send to, which they do when they end. */
static uint64_t redirected(const struct feed *feed) {
    struct deadman *acting = feed->deadman->acting;
    for (uint64_t left = feed->to; left; left &= left - 1) {
        const struct sender *sender = feed->deadman->destinations[__builtin_ctzll(left)].sender;
        for (struct deadman *each = acting->fellow; each != acting; each = each->fellow) {
            uint64_t own = each->own & placed(each, sender);
            each->armed = feed->disarms ? each->armed & ~own : each->armed | own;
        }
    }
    return renumbered(acting, feed->deadman, feed->to);
}

static void feed_one(struct timers *timers, const struct feed *feed, int64_t now) {
    struct deadman *deadman = feed->deadman->acting;
    uint64_t to = feed->to;
    if (feed->disarms)
        for (uint32_t index = 0; index < feed->superseded_count; index++)
            deferral_supersede(timers, feed->superseded[index], now);
    if (deadman != feed->deadman && !(to = redirected(feed))) return;
    if (feed->disarms) disarm(timers, deadman, to);
    else arm(timers, deadman, to, now);
}

/* A command was sent, and an ICMP message says that the board refused an earlier one. The message may be forged, and whether
 * the board executes this command is unknown: so arm the destination, but do not extend the deadline. */
static void arm_one(struct timers *timers, const struct feed *feed, int64_t now) {
    struct deadman *deadman = feed->deadman->acting;
    if (feed->disarms) return;
    uint64_t to = deadman == feed->deadman ? feed->to : redirected(feed);
    if (!to) return;
    to |= deadman->followers;
    end_start(timers, deadman, to);
    if (!deadman->armed) timer_set_due(timers, &deadman->timer, now + deadman->timeout);
    if (deadman->has_tripped) await_answers(timers, deadman, to & ~deadman->armed, now);
    deadman->armed |= to;
}

static int64_t last_heard(const struct timers *timers, const struct deadman *deadman, uint32_t index) {
    const struct deadman_destination *to = &deadman->destinations[index];
    bool is_known = to->is_heard && timers->heard;
    return is_known ? atomic_load_explicit(&timers->heard[to->last_seen], memory_order_relaxed) : 0;
}

/* Return the destinations that get the datagrams of the start for the last time: they were heard since they got the first
 * ones, or nobody can hear them. */
static uint64_t reachable(const struct timers *timers, const struct deadman *deadman) {
    uint64_t found = 0;
    for (uint64_t left = deadman->unstarted; left; left &= left - 1) {
        uint32_t index = (uint32_t)__builtin_ctzll(left);
        bool was_heard = last_heard(timers, deadman, index) != deadman->heard_at[index];
        if (!deadman->destinations[index].is_heard || (deadman->started & bit(index) && was_heard)) found |= bit(index);
    }
    return found;
}

/* Send the datagrams of the start, and determine when to repeat it. */
static uint64_t start(struct timers *timers, struct deadman *deadman, int64_t now) {
    uint64_t are_last = reachable(timers, deadman);
    for (uint64_t left = deadman->unstarted & ~deadman->started; left; left &= left - 1) {
        uint32_t index = (uint32_t)__builtin_ctzll(left);
        deadman->heard_at[index] = last_heard(timers, deadman, index);
    }
    struct outcome outcome = send_all(timers, deadman, deadman->unstarted);
    deadman->started |= deadman->unstarted & ~outcome.failed;
    uint64_t again = deadman->unstarted & (outcome.failed | ~are_last);
    int64_t due = again ? now + START_AGAIN : NEVER;
    deadman->unstarted = deadman->greets_again == NEVER ? again : deadman->own;
    timer_set_due(timers, &deadman->starting, due < deadman->greets_again ? due : deadman->greets_again);
    deadman->greets_again = NEVER;
    return outcome.reached;
}

/* Send a last time to what is armed. */
static void end(struct timers *timers, struct timer *timer, int64_t now) {
    struct deadman *deadman = (struct deadman *)timer;
    (void)now;
    uint64_t armed = deadman->armed;
    deadman->armed = 0;
    timer_set_due(timers, timer, NEVER);
    end_start(timers, deadman, deadman->own);
    deadman->greets_until = 0;
    send_all(timers, deadman, armed);
}

static void serve(struct timers *timers, struct timer *timer, int64_t now) {
    struct deadman *deadman = (struct deadman *)timer;
    if (deadman->is_ending) {
        end(timers, timer, now);
        return;
    }
    /* Skip repetitions that a stalled process has missed. */
    timer_set_due(timers, timer, timer->due + deadman->repeat * ((now - timer->due) / deadman->repeat + 1));
    if (deadman->has_tripped) {
        send_all(timers, deadman, deadman->armed);
        check_answers(timers, deadman, now);
        return;
    }
    set_tripped(deadman, true);
    deadman->tripped_at = now;
    await_answers(timers, deadman, deadman->armed, now);
    counter_set(timers->env->counters, deadman->active, 1);
    env_count(timers->env, deadman->trips, 1);
    note(timers, ACTION_TRIPPED, deadman);
    send_all(timers, deadman, deadman->armed);
    report(timers, EVENT_TRIPPED, deadman);
}

static struct deadman *starting(struct timer *timer) {
    return (struct deadman *)((char *)timer - offsetof(struct deadman, starting));
}

static void serve_start(struct timers *timers, struct timer *timer, int64_t now) { start(timers, starting(timer), now); }

static void leave_start(struct timers *timers, struct timer *timer, int64_t now) {
    (void)now;
    struct deadman *deadman = starting(timer);
    end_start(timers, deadman, deadman->own);
}

static const struct timer_kind DEADMAN = {.serve = serve, .end = end}, STARTING = {.serve = serve_start, .end = leave_start};

static void leave_fellows(struct deadman *deadman) {
    struct deadman *before = deadman;
    while (before->fellow != deadman) before = before->fellow;
    before->fellow = deadman->fellow;
    deadman->fellow = deadman;
}

/* Let `next` act for all deadmen that `earlier` acts for. */
static void redirect(struct deadman *next, struct deadman *earlier) {
    struct deadman *fellow = next->fellow;
    next->fellow = earlier->fellow; /* makes one circle of two */
    earlier->fellow = fellow;
    next->acting = next;
    for (struct deadman *each = next->fellow; each != next; each = each->fellow) each->acting = next;
}

/* Leave only those destinations to `earlier` that `next` does not send to. */
static void leave_others(const struct deadman *next, struct deadman *earlier) {
    for (uint32_t index = 0; index < next->count; index++)
        earlier->own &= ~placed(earlier, next->destinations[index].sender);
    earlier->armed &= earlier->own;
}

/* Pass on that destinations get the datagrams of the start. One whose address has changed gets them as for the first time. */
static void inherit_start(struct timers *timers, struct deadman *next, struct deadman *earlier) {
    int64_t due = earlier->starting.due;
    uint64_t unstarted = earlier->unstarted;
    end_start(timers, earlier, unstarted);
    if (!next->starts) return;
    for (uint64_t left = unstarted; left; left &= left - 1) {
        uint32_t index = (uint32_t)__builtin_ctzll(left);
        const struct deadman_destination *from = &earlier->destinations[index];
        uint64_t same = named(next, from->id) & ~next->armed;
        if (!same) continue;
        next->unstarted |= same;
        if (earlier->started & bit(index) && same & placed(next, from->sender)) {
            next->started |= same;
            next->heard_at[__builtin_ctzll(same)] = earlier->heard_at[index];
        }
    }
    if (!next->unstarted) return;
    if (earlier->greets_again < next->greets_again) next->greets_again = earlier->greets_again;
    if (due < next->starting.due) timer_set_due(timers, &next->starting, due);
}

/* Let `next` await the answers that `earlier` awaits; of a destination that `earlier` does not watch, from now on. */
static void pass_answers(struct timers *timers, struct deadman *next, struct deadman *earlier) {
    next->tripped_at = earlier->tripped_at;
    await_answers(timers, next, next->armed, timers->env->now(timers->env));
    for (uint64_t left = earlier->watched; left; left &= left - 1) {
        uint32_t index = (uint32_t)__builtin_ctzll(left);
        struct answer passed = earlier->answers[index];
        await_answers(timers, earlier, bit(index), 0);
        uint64_t same = passed.owed_since ? next->watched & named(next, earlier->destinations[index].id) : 0;
        if (!same) continue;
        uint32_t other = (uint32_t)__builtin_ctzll(same);
        set_disobeys(timers, next, other, passed.disobeys);
        next->answers[other] = passed;
    }
}

/* Pass on that destinations are armed. If `next` is armed, because of a later command or because it also replaces another
 * deadman, it trips at the later deadline. */
static void inherit_deadline(struct timers *timers, struct deadman *next, struct deadman *earlier, uint64_t armed,
                             int64_t due) {
    bool was_armed = next->armed, has_tripped = earlier->has_tripped;
    if (armed & ~next->followers) armed |= next->followers;
    next->armed |= armed;
    if (!armed || (was_armed && has_tripped)) {
        release(timers, earlier);
        return;
    }
    due += has_tripped ? next->repeat - earlier->repeat : next->timeout - earlier->timeout;
    if (was_armed && !next->has_tripped && due < next->timer.due) return;
    release(timers, next);
    timer_set_due(timers, &next->timer, due);
    if (!has_tripped) return;
    set_tripped(earlier, false);
    set_tripped(next, true);
    pass_answers(timers, next, earlier);
    counter_set(timers->env->counters, earlier->active, 0);
    counter_set(timers->env->counters, next->active, 1);
}

/* Pass deadline and state on. */
static void take_over(struct timers *timers, struct deadman *next, struct deadman *earlier) {
    uint64_t armed = renumbered(next, earlier, earlier->armed);
    bool was_armed = earlier->armed;
    int64_t due = earlier->timer.due;
    redirect(next, earlier);
    leave_others(next, earlier);
    next->greets_until = next->starts ? earlier->greets_until : 0;
    timer_set_due(timers, &earlier->timer, NEVER);
    if (was_armed) inherit_deadline(timers, next, earlier, armed, due);
    inherit_start(timers, next, earlier);
}

/* ---- public ---- */

struct deadman *deadman_open(struct timers *timers, int64_t timeout, int64_t repeat, bool starts, uint32_t active,
                             uint32_t trips, uint32_t id, const struct deadman_destination *destinations,
                             uint32_t count) {
    size_t datagrams = 0, bytes = 0;
    for (uint32_t index = 0; index < count; index++) bytes += destinations[index].beside.count * sizeof(struct beside_field);
    for (uint32_t index = 0; index < count; index++)
        for (uint32_t each = 0; each < destinations[index].count; each++, datagrams++)
            bytes += destinations[index].datagrams[each].size;
    size_t own = sizeof(struct deadman) + count * (sizeof *destinations + sizeof(struct answer) + sizeof(int64_t));
    struct deadman *deadman = calloc(1, own + datagrams * sizeof(struct deadman_datagram) + bytes);
    if (!deadman) return NULL;
    *deadman = (struct deadman){.timer = {.kind = &DEADMAN, .due = NEVER},
                                .starting = {.kind = &STARTING, .due = NEVER}, .acting = deadman, .timeout = timeout,
                                .repeat = repeat, .starts = starts, .active = active, .trips = trips, .id = id,
                                .count = count, .greets_again = NEVER};
    deadman->fellow = deadman;
    for (uint32_t index = 0; index < count; index++) {
        deadman->own |= bit(index);
        if (destinations[index].follows) deadman->followers |= bit(index);
        if (destinations[index].within) deadman->watched |= bit(index);
    }
    deadman->answers = (struct answer *)&deadman->destinations[count];
    deadman->heard_at = (int64_t *)&deadman->answers[count];
    struct deadman_datagram *copy = (struct deadman_datagram *)&deadman->heard_at[count];
    struct beside_field *fields = (struct beside_field *)(copy + datagrams);
    for (uint32_t index = 0; index < count; index++) {
        const struct beside *beside = &destinations[index].beside;
        deadman->destinations[index] = destinations[index];
        deadman->destinations[index].beside.fields = fields;
        for (uint32_t each = 0; each < beside->count; each++) *fields++ = beside->fields[each];
    }
    uint8_t *data = (uint8_t *)fields;
    for (uint32_t index = 0; index < count; index++) {
        const struct deadman_destination *from = &destinations[index];
        deadman->destinations[index].datagrams = copy;
        for (uint32_t each = 0; each < from->count; each++, copy++) {
            *copy = (struct deadman_datagram){memcpy(data, from->datagrams[each].data, from->datagrams[each].size),
                                              from->datagrams[each].size};
            data += copy->size;
        }
    }
    pthread_mutex_lock(&timers->lock);
    timers_add(timers, &deadman->timer);
    timers_add(timers, &deadman->starting);
    pthread_mutex_unlock(&timers->lock);
    return deadman;
}

void deadman_close(struct timers *timers, struct deadman *deadman) {
    pthread_mutex_lock(&timers->lock);
    timers_remove(timers, &deadman->timer);
    timers_remove(timers, &deadman->starting);
    leave_fellows(deadman);
    pthread_mutex_unlock(&timers->lock);
    free(deadman);
}

uint64_t deadman_start(struct timers *timers, struct deadman *deadman, int64_t now) {
    if (!deadman->starts) return 0;
    pthread_mutex_lock(&timers->lock);
    deadman->unstarted = deadman->own;
    deadman->started = 0;
    uint64_t reached = start(timers, deadman, now);
    pthread_mutex_unlock(&timers->lock);
    return reached;
}

void deadmen_send_first(struct timers *timers, const struct sender *sender) {
    for (struct timer *each = timers->first; each; each = each->next) {
        if (each->kind != &DEADMAN) continue;
        struct deadman *deadman = (struct deadman *)each;
        send_all(timers, deadman, placed(deadman, sender) & (deadman->starts ? deadman->own : deadman->armed));
    }
}

void deadman_await_subscribers(struct timers *timers, struct deadman *deadman, int64_t now) {
    pthread_mutex_lock(&timers->lock);
    deadman->greets_until = deadman->starts ? now + START : 0;
    pthread_mutex_unlock(&timers->lock);
}

bool deadman_greet(struct timers *timers, struct deadman *deadman, int64_t now) {
    pthread_mutex_lock(&timers->lock);
    bool greets = now < deadman->greets_until && !deadman->armed;
    if (greets) {
        deadman->unstarted = deadman->own;
        timer_set_due(timers, &deadman->starting, now);
        deadman->greets_again = now + GREETING;
    }
    pthread_mutex_unlock(&timers->lock);
    return greets;
}

void deadman_replace(struct timers *timers, struct deadman *next, struct deadman *earlier) {
    pthread_mutex_lock(&timers->lock);
    take_over(timers, next, earlier);
    pthread_mutex_unlock(&timers->lock);
}

bool deadman_is_tripped(const struct deadman *deadman) {
    return __atomic_load_n(&deadman->has_tripped, __ATOMIC_RELAXED);
}

bool deadman_is_shown(struct timers *timers, struct deadman *deadman, uint32_t id, bool obeys, int64_t arrived) {
    bool is_evidence = false;
    pthread_mutex_lock(&timers->lock);
    deadman = deadman->acting;
    bool counts = deadman->has_tripped && arrived > deadman->tripped_at;
    for (uint64_t left = counts ? deadman->watched & named(deadman, id) : 0; left; left &= left - 1) {
        uint32_t index = (uint32_t)__builtin_ctzll(left);
        if (!deadman->answers[index].owed_since) continue;
        if (obeys) take_obedience(timers, deadman, index, arrived);
        else is_evidence |= take_disobedience(deadman, index, arrived);
    }
    pthread_mutex_unlock(&timers->lock);
    return is_evidence;
}

void command_has_left(struct timers *timers, const struct feed *feeds, uint32_t count, int refused, int64_t now) {
    for (uint32_t index = 0; index < count; index++) {
        if (refused) arm_one(timers, &feeds[index], now);
        else feed_one(timers, &feeds[index], now);
    }
}

void deadman_feed(struct timers *timers, struct deadman *deadman, int64_t now) {
    struct feed feed = {.deadman = deadman, .to = bit(0)};
    pthread_mutex_lock(&timers->lock);
    note(timers, ACTION_FED, deadman);
    command_has_left(timers, &feed, 1, 0, now);
    pthread_mutex_unlock(&timers->lock);
}

void deadman_schedule_end(struct timers *timers, struct timer *timer) {
    if (timer->kind == &STARTING) return; /* with its deadman */
    struct deadman *deadman = (struct deadman *)timer;
    deadman->is_ending = deadman->armed;
    timer_set_due(timers, timer, deadman->armed ? 0 : NEVER);
    end_start(timers, deadman, deadman->own);
    deadman->greets_until = 0;
}

void deadman_end_by_thread(struct timers *timers, struct deadman *deadman) {
    pthread_mutex_lock(&timers->lock);
    deadman_schedule_end(timers, &deadman->timer);
    pthread_mutex_unlock(&timers->lock);
}

static bool is_served(const struct timers *timers, const struct timer *timer) {
    for (const struct timer *each = timers->first; each; each = each->next)
        if (each == timer) return true;
    return false;
}

void deadman_settle(struct timers *timers, struct timer *timer, const struct deadman_destination *to, const char *why,
                    int64_t now) {
    env_count(timers->env, why ? to->send_errors : to->sent, 1);
    if (!why || !is_served(timers, timer)) return;
    struct deadman *deadman = timer->kind == &STARTING ? starting(timer) : (struct deadman *)timer;
    report_error(timers, deadman, to, 0, why);
    deadman = deadman->acting;
    if (deadman->armed || now >= deadman->greets_until || deadman->starting.due <= now + START_AGAIN) return;
    deadman->unstarted = deadman->own;
    timer_set_due(timers, &deadman->starting, now + START_AGAIN);
}

int command_send_at(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                    const struct feed *feeds, uint32_t count, int64_t now) {
    if (now > expires) return COMMAND_STALE;
    int error = sender_send_only(sender, data, size);
    if (error) return error;
    int refused = sender_take_refused(sender);
    if (!count) return refused;
    command_has_left(timers, feeds, count, refused, now);
    return refused;
}

int command_send(struct timers *timers, struct sender *sender, const void *data, size_t size, int64_t expires,
                 const struct feed *feeds, uint32_t count) {
    if (!count) {
        int64_t now = expires == NEVER ? 0 : timers->env->now(timers->env);
        return command_send_at(timers, sender, data, size, expires, feeds, count, now);
    }
    pthread_mutex_lock(&timers->lock);
    int error = command_send_at(timers, sender, data, size, expires, feeds, count,
                                timers->env->now(timers->env));
    pthread_mutex_unlock(&timers->lock);
    return error;
}
