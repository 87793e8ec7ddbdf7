/* The thread for messages from ROS is offered another set while it is stuck in the middleware. The set is taken back and
 * freed, and the thread goes on with what it has served. */
#include "from_ros.h"

#include <assert.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "../middleware.c"
#include "clock.h"

enum { RECEIVED, LAST, DURATION, COUNTERS = 64 };

static const uint8_t MESSAGE[] = {0, 1, 0, 0};
static const struct read_operation STEPS[1];
static const struct section NODE = {.steps = STEPS};
static const struct value DEFAULTS[2];
static const struct layout LAYOUT = {.sections = &NODE, .defaults = DEFAULTS, .slot_count = 2, .is_cdr = 1};

static int take(const void *subscription, void *message, void *info, void *allocation) {
    return middleware_take((struct subscription *)subscription, message, info, allocation);
}

int main(void) {
    static counter counters[COUNTERS];
    struct ring *events = ring_open(1 << 12);
    struct from_ros *thread = from_ros_open(NULL, counters, events, take, middleware_reset, false);
    struct ros_route route = {.targets = {.layout = &LAYOUT, .topic = NO_NAME}, .seconds = NONE, .nanoseconds = NONE,
                              .received = RECEIVED, .last_message = LAST, .duration = DURATION};
    struct ros_topic topics[2];
    for (int index = 0; index < 2; index++) {
        topics[index] = (struct ros_topic){middleware_open(), &route, 1, 4, eventfd(0, 0), 0};
        assert(!from_ros_watch(thread, topics[index].eventfd));
    }
    struct ros_set both = {topics, 2, 0};
    assert(from_ros_serve(thread, &both));
    struct subscription *first = (struct subscription *)topics[0].subscription;
    middleware_set(first, true, false);
    struct ros_set *refused = calloc(1, sizeof *refused);
    assert(!from_ros_serve(thread, refused));
    free(refused);
    middleware_put(first, MESSAGE, sizeof MESSAGE, wall_ns(), 0);
    middleware_set(first, false, false);
    assert(from_ros_serve(thread, &both));
    assert(from_ros_stop(thread));
    assert(counters[RECEIVED] == 1);
    for (int index = 0; index < 2; index++) {
        close(topics[index].eventfd);
        free((void *)topics[index].subscription);
    }
    ring_close(events);
    return 0;
}
