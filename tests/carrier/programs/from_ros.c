/* Commands come on two topics while programs change, deadmen are served and counters are read; then the thread stops.
 * What was put is counted once. */
#include "from_ros.h"

#include <assert.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "../middleware.c"
#include "clock.h"

enum { MESSAGES = 2000, RECEIVED = 0, LAST, SENT, BYTES, LOST, DURATION, COUNTERS = 64 };

static const uint8_t MESSAGE[] = {0, 1, 0, 0, 0, 0, 1, 0}; /* 65536, a varint of three bytes */
static const struct beside_field NUMBER = {.offset = 1, .size = 3, .encoding = BESIDE_VARINT, .value = BESIDE_NUMBER, .bits = 21};
static const struct read_operation STEPS[] = {{.kind = READ_SCALAR, .type = SCALAR_UINT32, .slot = 2}};
static const struct section NODE = {.steps = STEPS, .count = 1};
static const struct value DEFAULTS[3];
static const struct layout LAYOUT = {.sections = &NODE, .defaults = DEFAULTS, .slot_count = 3, .is_cdr = 1};
static const struct operation OPERATIONS[] = {{.kind = OP_LOAD, .slot = 2}, {.kind = OP_WRITE_VARINT, .size = 8}};

struct source {
    struct subscription *subscription;
    int eventfd;
};

static void *publish(void *of) {
    struct source *source = of;
    for (int left = MESSAGES; left; left--) {
        middleware_put(source->subscription, MESSAGE, sizeof MESSAGE, wall_ns(), 0);
        eventfd_write(source->eventfd, 1);
        if (left % 64 == 0) usleep(100);
    }
    return NULL;
}

/* Commands and brakes leave in the order of their numbers. */
static void *drain(void *of) {
    uint8_t datagram[64];
    for (int last = 0; recv(*(int *)of, datagram, sizeof datagram, 0) > 0;) {
        int number = (datagram[1] & 0x7F) | (datagram[2] & 0x7F) << 7 | datagram[3] << 14;
        assert(number > last);
        last = number;
    }
    return NULL;
}

static int take(const void *subscription, void *message, void *info, void *allocation) {
    return middleware_take((struct subscription *)subscription, message, info, allocation);
}

int main(void) {
    static counter counters[COUNTERS], braked[COUNTERS];
    int pair[2];
    assert(!socketpair(AF_UNIX, SOCK_SEQPACKET, 0, pair));
    struct sender *sender = sender_open(pair[0], -1, 1, 1);
    struct ring *events = ring_open(1 << 12);
    struct timers *timers = timers_open(braked, NULL);
    struct beside beside = {sequence_open(), &NUMBER, 1, 0};
    struct deadman_datagram brake = {MESSAGE, 4};
    struct deadman_destination braking = {.sender = sender, .datagrams = &brake, .beside = beside, .count = 1, .sent = 2,
                                          .send_errors = 3};
    struct deadman *deadman = deadman_open(timers, 1000, 1000000, true, 0, 1, 0, &braking, 1);
    struct feed feed = {.deadman = deadman, .to = 1};
    struct target target = {.message = {OPERATIONS, 2, 0}, .sender = sender, .feeds = &feed, .feed_count = 1,
                            .is_ordered = 1, .beside = &beside, .delivered = SENT, .delivered_bytes = BYTES};
    for (int reason = 0; reason < DROP_REASONS; reason++) target.dropped[reason] = LOST;
    struct ros_route route = {
        .targets = {.ttl = 1000000000, .layout = &LAYOUT, .targets = &target, .count = 1, .topic = NO_NAME},
        .seconds = NONE, .nanoseconds = NONE, .received = RECEIVED, .last_message = LAST, .duration = DURATION};
    struct from_ros *thread = from_ros_open(timers, counters, events, take, middleware_reset, true);
    struct source sources[2];
    struct ros_topic topics[2];
    for (int index = 0; index < 2; index++) {
        sources[index] = (struct source){middleware_open(), eventfd(0, 0)};
        assert(!from_ros_watch(thread, sources[index].eventfd));
        topics[index] = (struct ros_topic){sources[index].subscription, &route, 1, MESSAGES, sources[index].eventfd, 0};
    }
    struct ros_set both = {topics, 2, 0}, one = {topics, 1, 0};
    pthread_t publishing[2], draining;
    pthread_create(&draining, NULL, drain, &pair[1]);
    for (int index = 0; index < 2; index++) pthread_create(&publishing[index], NULL, publish, &sources[index]);
    for (int times = 200; times; times--) {
        int64_t copy[COUNTERS];
        assert(from_ros_serve(thread, times % 2 ? &one : &both));
        timers_serve(timers, boottime_ns());
        if (from_ros_counters(thread, copy, COUNTERS)) assert(copy[RECEIVED] == copy[SENT] + copy[LOST]);
    }
    for (int index = 0; index < 2; index++) pthread_join(publishing[index], NULL);
    assert(from_ros_serve(thread, &both));
    assert(from_ros_stop(thread));
    assert(counters[RECEIVED] == 2 * MESSAGES && counters[SENT] + counters[LOST] == 2 * MESSAGES);
    for (int index = 0; index < 2; index++) {
        close(sources[index].eventfd);
        free(sources[index].subscription);
    }
    shutdown(pair[0], SHUT_RDWR);
    pthread_join(draining, NULL);
    deadman_close(timers, deadman);
    sequence_close(beside.sequence);
    timers_close(timers);
    sender_close(sender);
    ring_close(events);
    return 0;
}
