/* Delivers messages without threads, sockets, clocks and middleware: what would leave is written down. A library of its
 * own, which uses that of the carrier. */
#define deliver_to_all note_all
#include "collect.h"
#include "earliest.h"
#include "route_ros.c"
#undef deliver_to_all
static bool note(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message);
#define deliver note
#include "each.c"
#undef deliver

enum { DELIVERED = -1, FILTERED_OUT = -2 };

/* What became of a message at a target, in the order in which it did. The bytes that would leave follow. */
struct noted {
    uint32_t size, target;
    int32_t outcome; /* DELIVERED, FILTERED_OUT, or an enum drop_reason */
    uint32_t place, length, reserved;
};

/* What it has delivered since the last call. */
struct delivering {
    struct ros_routing routing; /* first, as its env is */
    struct output notes, bytes, losses;
    int64_t now;
};

struct delivering *seam_open(counter *counters);
void seam_close(struct delivering *of);
size_t seam_datagram(struct delivering *of, const struct targets *to, const void *data, uint32_t size, uint32_t start,
                     uint32_t length, bool is_single, uint32_t column, int64_t received_at, const void **notes);
size_t seam_part(struct delivering *of, const struct targets *to, const void *data, uint32_t size, uint32_t start,
                 uint32_t length, bool is_single, uint32_t column, int64_t received_at, int64_t now, const void **notes);
void seam_adopt(struct delivering *of, const struct timer_change *change);
int64_t seam_serve(struct delivering *of, int64_t now);
size_t seam_losses(struct delivering *of, const void **events);
size_t seam_from_ros(struct delivering *of, const struct ros_route *route, const void *data, size_t size,
                     int64_t received_at, const void **notes);

static int64_t now_of(struct thread_env *env) { return ((struct delivering *)env)->now; }

static int note_sent(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size, int64_t expires) {
    struct delivering *of = (struct delivering *)env;
    (void)target, (void)expires;
    of->bytes.size = 0;
    return !append(&of->bytes, data, size);
}

static enum publication note_published(struct thread_env *env, const struct targets *to, const struct target *target,
                                       const char **why) {
    (void)to;
    struct output *written = &env->machine.output;
    *why = "";
    return note_sent(env, target, written->data, written->size, NEVER) ? PUBLISH_FAILED : PUBLISHED;
}

/* Counters of targets: which of them has counted says what became of a message. */
static int32_t outcome_of(const struct delivering *of, const struct target *target, const int64_t *before) {
    const counter *counters = of->routing.env.counters;
    if (counters[target->delivered] != before[0]) return DELIVERED;
    if (counters[target->filtered] != before[1]) return FILTERED_OUT;
    for (int32_t reason = 0; reason < DROP_REASONS; reason++)
        if (counters[target->dropped[reason]] != before[2 + reason]) return reason;
    abort();
}

typedef bool serve(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message);

/* Serve a message, and note what became of it, unless that was noted for each element. */
static bool note_by(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message,
                    serve *serve) {
    struct delivering *of = (struct delivering *)env;
    counter *counters = env->counters;
    int64_t before[2 + DROP_REASONS] = {counters[target->delivered], counters[target->filtered]};
    for (int reason = 0; reason < DROP_REASONS; reason++) before[2 + reason] = counters[target->dropped[reason]];
    struct { struct lost_event event; char text[256]; } lost = {0};
    env->reporter.left = 1;
    of->bytes.size = 0;
    size_t noted_before = of->notes.size;
    bool goes_on = serve(env, to, target, message);
    if (of->notes.size != noted_before) return goes_on;
    ring_take(env->reporter.events, &lost, sizeof lost, 0);
    struct noted noted = {.target = (uint32_t)(target - to->targets), .outcome = outcome_of(of, target, before),
                          .place = lost.event.place, .length = (uint32_t)of->bytes.size};
    noted.size = (uint32_t)(sizeof noted + (of->bytes.size + 7) / 8 * 8);
    static const uint8_t zeros[8];
    if (!append(&of->notes, &noted, sizeof noted) || !append(&of->notes, of->bytes.data, of->bytes.size) ||
        !append(&of->notes, zeros, noted.size - sizeof noted - of->bytes.size))
        abort();
    return goes_on;
}

static bool note(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message) {
    return note_by(env, to, target, message, deliver);
}

bool note_all(struct thread_env *env, const struct targets *to, struct message *message) {
    for (uint32_t index = 0; index < to->count; index++)
        if (!note_by(env, to, &to->targets[index], message, to->targets[index].for_each ? deliver_each : deliver))
            return false;
    return true;
}

struct delivering *seam_open(counter *counters) {
    struct delivering *made = calloc(1, sizeof *made);
    if (!made) return NULL;
    struct thread_env *env = &made->routing.env;
    struct timers *timers = timers_open_on(env, false);
    if (!timers || !env_open(env, counters, ring_open(1 << 16), timers)) abort();
    env->now = now_of;
    env->send = note_sent;
    env->publish = note_published;
    return made;
}

void seam_close(struct delivering *of) {
    ring_close(of->routing.env.reporter.events);
    timers_close(of->routing.env.timers);
    env_close(&of->routing.env);
    free(of->notes.data);
    free(of->bytes.data);
    free(of->losses.data);
    free(of);
}

/* Return `size` bytes of which a sanitizer sees what is read behind them. */
static void *exactly(const void *data, size_t size) {
    void *copy = malloc(size ? size : 1);
    if (!copy) abort();
    if (size) memcpy(copy, data, size);
    return copy;
}

/* Deliver a datagram. Return how many bytes of notes there are. */
size_t seam_datagram(struct delivering *of, const struct targets *to, const void *data, uint32_t size, uint32_t start,
                     uint32_t length, bool is_single, uint32_t column, int64_t received_at, const void **notes) {
    void *copy = exactly(data, size);
    struct datagram datagram = {.data = copy, .size = size, .start = start, .length = length, .is_single = is_single,
                                .column = column, .received_at = received_at};
    struct message message = {.datagram = &datagram};
    of->notes.size = 0;
    note_all(&of->routing.env, to, &message);
    free(copy);
    *notes = of->notes.data;
    return of->notes.size;
}

/* Keep what was reported, in which frames and datagrams were lost before they were delivered. */
static void keep_losses(struct delivering *of) {
    uint64_t records[512];
    for (size_t size; (size = ring_take(of->routing.env.reporter.events, records, sizeof records, 0));)
        if (!append(&of->losses, records, size)) abort();
    of->routing.env.reporter.window_began = INT64_MIN / 2; /* report all */
}

/* The events since the last call. */
size_t seam_losses(struct delivering *of, const void **events) {
    size_t size = of->losses.size;
    *events = of->losses.data;
    of->losses.size = 0;
    return size;
}

/* Deliver a datagram to targets that get frames, likewise, at `now`. Without notes, it completes none. */
size_t seam_part(struct delivering *of, const struct targets *to, const void *data, uint32_t size, uint32_t start,
                 uint32_t length, bool is_single, uint32_t column, int64_t received_at, int64_t now, const void **notes) {
    void *copy = exactly(data, size);
    struct datagram datagram = {.data = copy, .size = size, .start = start, .length = length, .is_single = is_single,
                                .column = column, .received_at = received_at};
    struct message message = {.datagram = &datagram, .now = now, .times = {now, now}};
    of->now = now;
    of->notes.size = 0;
    bool is_complete = collect(&of->routing.env, to, &message);
    free(copy); /* what is kept is copied */
    datagram.data = NULL;
    keep_losses(of);
    if (is_complete) note_all(&of->routing.env, to, &message);
    *notes = of->notes.data;
    return of->notes.size;
}

void seam_adopt(struct delivering *of, const struct timer_change *change) {
    timers_change(of->routing.env.timers, change);
    keep_losses(of);
}

/* Serve the timers that are due, and return when the next one is. */
int64_t seam_serve(struct delivering *of, int64_t now) {
    of->now = now;
    timers_serve(of->routing.env.timers, now);
    keep_losses(of);
    return earliest(of->routing.env.timers);
}

/* Serve a message from ROS, likewise. */
size_t seam_from_ros(struct delivering *of, const struct ros_route *route, const void *data, size_t size,
                     int64_t received_at, const void **notes) {
    static struct ros_publisher publisher;
    void *copy = exactly(data, size);
    struct taken served = {.data = copy, .size = size, .received_at = received_at, .publisher = &publisher};
    of->notes.size = 0;
    route_ros(&of->routing, route, &served);
    free(copy);
    *notes = of->notes.data;
    return of->notes.size;
}
