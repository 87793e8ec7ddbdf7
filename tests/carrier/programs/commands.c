/* Commands come on two topics while programs change, deadmen are served and counters are read; then the thread stops.
 * What was put is counted once. */
#include "commands.h"

#include <assert.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "../middleware.c"
#include "clock.h"

enum { MESSAGES = 2000, RECEIVED = 0, LAST, SENT, BYTES, LOST, DURATION, COUNTERS = 64 };

static const uint8_t MESSAGE[] = {0, 1, 0, 0, 7, 0, 0, 0};
static const struct read_op READS[] = {{READ_SCALARS, 4, 0, 1}};
static const struct write_op WRITES[] = {
    {.kind = WRITE_SCALAR, .scalar = SCALAR_UINT32, .encoding = AS_VARINT, .tag = 8},
};

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

static void *drain(void *of) {
    char datagram[64];
    while (recv(*(int *)of, datagram, sizeof datagram, 0) > 0) {}
    return NULL;
}

static int take(const void *subscription, void *message, void *info, void *allocation) {
    return middleware_take((struct subscription *)subscription, message, info, allocation);
}

int main(void) {
    static counter counters[COUNTERS], braked[COUNTERS];
    int pair[2];
    assert(!socketpair(AF_UNIX, SOCK_SEQPACKET, 0, pair));
    struct sender *sender = sender_open(pair[0], -1, 0, 0);
    struct ring *events = ring_open(1 << 12);
    struct deadmen *deadmen = deadmen_open(braked, NULL);
    struct deadman_destination braking = {.sender = sender, .datagram = MESSAGE, .size = 1, .sent = 2, .send_errors = 3};
    struct deadman *deadman = deadman_open(deadmen, 1000, 1000000, true, 0, 1, 0, &braking, 1);
    struct feed feed = {deadman, 0, 0};
    struct command_target target = {
        .destination = {.sender = sender, .feeds = &feed, .feed_count = 1, .sent = SENT, .sent_bytes = BYTES,
                        .stale = LOST, .rate_limited = LOST, .send_buffer_full = LOST, .send_error = LOST},
        .writes = WRITES, .write_count = 1, .mapping_error = LOST,
    };
    struct command_route route = {.ttl = 1000000000, .reads = READS, .targets = &target, .read_count = 1,
                                  .target_count = 1, .seconds = NO_SLOT, .nanoseconds = NO_SLOT, .received = RECEIVED,
                                  .last_message = LAST, .duration = DURATION};
    struct commands *commands = commands_open(deadmen, counters, events, take, middleware_reset, true);
    struct source sources[2];
    struct command_topic topics[2];
    for (int index = 0; index < 2; index++) {
        sources[index] = (struct source){middleware_open(), eventfd(0, 0)};
        assert(!commands_watch(commands, sources[index].eventfd));
        topics[index] = (struct command_topic){sources[index].subscription, &route, 1, MESSAGES, sources[index].eventfd, 0};
    }
    struct command_set both = {topics, 2, 0}, one = {topics, 1, 0};
    pthread_t publishing[2], draining;
    pthread_create(&draining, NULL, drain, &pair[1]);
    for (int index = 0; index < 2; index++) pthread_create(&publishing[index], NULL, publish, &sources[index]);
    for (int times = 200; times; times--) {
        int64_t copy[COUNTERS];
        assert(commands_serve(commands, times % 2 ? &one : &both));
        deadmen_serve(deadmen, boottime_ns());
        if (commands_counters(commands, copy, COUNTERS)) assert(copy[RECEIVED] == copy[SENT] + copy[LOST]);
    }
    for (int index = 0; index < 2; index++) pthread_join(publishing[index], NULL);
    assert(commands_serve(commands, &both));
    assert(commands_stop(commands));
    assert(counters[RECEIVED] == 2 * MESSAGES && counters[SENT] + counters[LOST] == 2 * MESSAGES);
    for (int index = 0; index < 2; index++) {
        close(sources[index].eventfd);
        free(sources[index].subscription);
    }
    shutdown(pair[0], SHUT_RDWR);
    pthread_join(draining, NULL);
    deadman_close(deadmen, deadman);
    deadmen_close(deadmen);
    sender_close(sender);
    ring_close(events);
    return 0;
}
