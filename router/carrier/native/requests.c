#include "requests.h"

#include <stdlib.h>

#include "clock.h"

struct requests {
    struct ros_routing routing; /* first: its functions get a pointer to it */
    int (*send)(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size, int64_t expires);
    edition edition; /* of the counters */
    const struct target *target;
    struct output sent;
    int outcome;
};

/* Send, and keep what was sent. */
static int send_and_keep(struct thread_env *env, const struct target *target, const uint8_t *data, size_t size,
                         int64_t expires) {
    struct requests *requests = (struct requests *)env;
    int error = requests->send(env, target, data, size, expires);
    requests->sent.size = 0;
    if (!error && append(&requests->sent, data, size)) requests->outcome = REQUEST_SENT;
    return error;
}

/* Note why the request is lost. */
static void note_loss(struct thread_env *env, uint32_t index, int64_t amount) {
    struct requests *requests = (struct requests *)env;
    (void)amount;
    for (int reason = 0; reason < DROP_REASONS; reason++)
        if (index == requests->target->dropped[reason]) requests->outcome = reason;
}

/* Count the loss of an earlier datagram (sender.h), as of one more request: it says nothing about this one. */
static void settle_earlier(struct requests *requests, const struct ros_route *route) {
    struct thread_env *env = &requests->routing.env;
    int error = sender_take_refused(requests->target->sender);
    if (!error) return;
    env_count(env, route->received, 1);
    struct lost_event lost = {.reason = DROP_SEND_ERROR, .error = error};
    lose_message(env, &route->targets, requests->target, boottime_ns(), lost, "");
}

static void begin(struct requests *requests, const struct ros_route *route) {
    requests->target = &route->targets.targets[0];
    edition_begin(&requests->edition);
    settle_earlier(requests, route);
    requests->outcome = DROP_SEND_ERROR;
}

static int end(struct requests *requests) {
    edition_end(&requests->edition);
    return requests->outcome;
}

struct requests *requests_open(struct timers *timers, counter *counters, struct ring *events) {
    struct requests *requests = calloc(1, sizeof *requests);
    if (!requests) return NULL;
    struct thread_env *env = &requests->routing.env;
    bool is_open = env_open(env, counters, events, timers);
    requests->send = env->send;
    env->send = send_and_keep;
    env->counted = note_loss;
    if (is_open) return requests;
    requests_close(requests);
    return NULL;
}

void requests_close(struct requests *requests) {
    env_close(&requests->routing.env);
    free(requests->sent.data);
    free(requests);
}

int requests_send(struct requests *requests, const struct ros_route *route, const void *data, size_t size,
                  int64_t called_at, struct sent_request *sent) {
    static const uint8_t gid[GID_SIZE];
    const struct ros_topic topic = {.routes = route, .route_count = 1};
    struct taken taken = {.data = data, .size = size, .published_at = called_at,
                          .publisher = find_publisher(&requests->routing, gid, route->targets.topic)};
    taken.publisher->sent = taken.publisher->stamped = INT64_MIN; /* any client may have sent it */
    taken.now = boottime_ns();
    taken.received_at = wall_ns();
    begin(requests, route);
    route_ros_message(&requests->routing, &topic, &taken);
    *sent = (struct sent_request){requests->sent.data, requests->sent.size};
    return end(requests);
}

int requests_send_again(struct requests *requests, const struct ros_route *route, const void *data, size_t size) {
    const struct targets *to = &route->targets;
    struct target again = to->targets[0];
    again.beside = NULL; /* it is filled already */
    begin(requests, route);
    env_count(&requests->routing.env, route->received, 1);
    deliver_now(&requests->routing.env, to, &again, data, size, NEVER, boottime_ns());
    return end(requests);
}

void requests_look(struct requests *requests) {
    int64_t now = boottime_ns();
    freshness_look(&requests->routing.freshness, wall_ns(), now);
}

bool requests_counters(struct requests *requests, int64_t *to, uint32_t count) {
    return counters_copy(&requests->edition, requests->routing.env.counters, to, count);
}
