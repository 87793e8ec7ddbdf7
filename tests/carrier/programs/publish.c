/* Programs replace each other without a pause while datagrams come as fast as they can and are published, by a middleware
 * that takes its time now and then, refuses, and is stuck at last. Counters are read, and all ends at some moment. Fails unless each topic gets its messages in order and from a program that is alive, and
 * the counters balance; sanitizers see the rest. A program is freed as soon as nobody can use it. */
#include "carrier.h"
#include "publish.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "check.h"
#include "clock.h"

enum { ROUNDS = 12, PROGRAMS = 24, TOPICS = 2, QUEUE = 1 << 12, ALIVE = 0x600d, NUMBER = 2, SLOTS = 3 };
/* Counters of each topic behind those of the listener and of the route. */
enum { RECEIVED, BYTES, PADDED, SUPERSEDED, REJECTED, UNKNOWN = REJECTED + REASONS, ACCEPTED, LAST, DURATION, TOPIC = DURATION + 14 };
enum { WAITING, QUEUE_FULL, FILTERED, PUBLICATIONS, STALE, LIMITED, MAPPING, NON_FINITE, REFUSED, OF_TOPIC };
enum { COUNTERS = TOPIC + TOPICS * OF_TOPIC };

/* All that a program refers to. */
struct made {
    struct program program;
    struct listener listener;
    struct choice choice;
    struct payload_case only;
    struct protocol protocol;
    struct route route;
    struct target targets[TOPICS];
    struct topic topics[TOPICS];
    struct wanted_field of_payload;
    struct section section;
    struct value defaults[SLOTS], source;
    struct operation operations[3];
    struct layout layout;
    uint32_t publishers[TOPICS]; /* ALIVE and their index */
};

/* All of a round. */
struct round {
    counter *received, *published;
    struct ring *events, *rejections, *messages;
    struct timers *timers;
    struct carrier *carrier;
    struct publish_thread *publishing;
    int socket;
};

static const struct wire_field of_envelope[] = {{1, WIRE_MESSAGE, WIRE_CASE | WIRE_ROUTED, 1}};
static const struct wire_field of_payload[] = {{1, WIRE_VARINT, 0, 0}};
static const struct wire_type types[] = {{of_envelope, 1, 0}, {of_payload, 1, 1}};

static const uint8_t header[] = {0, 1, 0, 0};
static struct limit limit = {1000, 500, -1000};
static struct limit *const limits[] = {&limit};
static struct demand demands[TOPICS];
static uint32_t latest[TOPICS]; /* numbers that were published; of the thread */
static _Atomic bool is_stuck, has_ended;
static _Atomic uint32_t inside;
static struct publish_thread *left[ROUNDS]; /* by the caller, with what they hold */

/* ---- the middleware ---- */

static int publish(const void *publisher, const void *of, void *unused) {
    static unsigned random = 1;
    const struct serialized_message *message = of;
    uint32_t kept = *(const uint32_t *)publisher, number;
    (void)unused;
    check(kept / TOPICS == ALIVE, "the publisher is alive");
    check(message->length == 8, "the message is whole");
    memcpy(&number, message->buffer + 4, sizeof number);
    check(number > latest[kept % TOPICS], "messages are in order");
    latest[kept % TOPICS] = number;
    unsigned chosen = (unsigned)rand_r(&random) % 1000;
    if (chosen < 20) usleep(chosen * 100);
    atomic_fetch_add(&inside, 1);
    while (atomic_load(&is_stuck)) usleep(100);
    atomic_fetch_sub(&inside, 1);
    return chosen == 999;
}

static struct error_text why(void) { return (struct error_text){"there is no room"}; }

static void forget(void) {}

/* ---- programs ---- */

static uint32_t topic_counter(int topic, int which) { return (uint32_t)(TOPIC + topic * OF_TOPIC + which); }

static void make_target(struct made *made, int index) {
    made->publishers[index] = (uint32_t)(ALIVE * TOPICS + index);
    made->topics[index] = (struct topic){&made->publishers[index], &demands[index]};
    made->targets[index] = (struct target){
        .topic = &made->topics[index], .message = {made->operations, 3, 0}, .id = (uint32_t)index + 1,
        .condition = {made->operations + 1, (uint32_t)index, 0}, .limits = index ? limits : NULL,
        .delivered = topic_counter(index, PUBLICATIONS), .waiting = topic_counter(index, WAITING),
        .filtered = topic_counter(index, FILTERED)};
    for (int reason = 0; reason < DROP_REASONS; reason++) made->targets[index].dropped[reason] = topic_counter(index, MAPPING);
    made->targets[index].dropped[DROP_QUEUE_FULL] = topic_counter(index, QUEUE_FULL);
    made->targets[index].dropped[DROP_STALE] = topic_counter(index, STALE);
    made->targets[index].dropped[DROP_RATE_LIMITED] = topic_counter(index, LIMITED);
    made->targets[index].dropped[DROP_NON_FINITE] = topic_counter(index, NON_FINITE);
    made->targets[index].dropped[DROP_PUBLISH_ERROR] = topic_counter(index, REFUSED);
}

static struct made *make(const struct round *env, uint32_t generation) {
    struct made *made = calloc(1, sizeof *made);
    check(made, "memory");
    made->of_payload = (struct wanted_field){.number = 1, .type = TYPE_UINT32, .slot = NUMBER, .presence = NONE, .section = NONE,
                                           .choice = NONE, .closed = NONE};
    made->section = (struct section){&made->of_payload, 1, 0, 0};
    made->operations[0] = (struct operation){.kind = OP_KNOWN, .size = sizeof header, .slot = 1};
    made->operations[1] = (struct operation){.kind = OP_LOAD, .slot = NUMBER};
    made->operations[2] = (struct operation){.kind = OP_PUT, .slot = 4};
    made->layout = (struct layout){.sections = &made->section, .defaults = made->defaults, .literals = header,
                                   .slot_count = SLOTS};
    for (int index = 0; index < TOPICS; index++) make_target(made, index);
    struct targets publishes = {.ttl = generation % 2 ? 0 : 5000000, .layout = &made->layout, .sources = &made->source,
                                .targets = made->targets, .count = TOPICS};
    made->route = (struct route){.publishes = publishes, .last_message = LAST, .duration = DURATION};
    made->only = (struct payload_case){.number = 1, .unhandled = UNKNOWN};
    made->choice = (struct choice){0, ACCEPTED};
    made->protocol = (struct protocol){.schema = {.types = types, .count = 2}, .cases = &made->only, .case_count = 1,
                                       .unknown_case = UNKNOWN};
    made->listener = (struct listener){.fd = env->socket, .protocol = &made->protocol, .choices = &made->choice, .columns = 1, .received = RECEIVED,
                                       .received_bytes = BYTES, .padded = PADDED, .superseded = SUPERSEDED};
    for (int reason = 0; reason < REASONS; reason++) made->listener.rejected[reason] = (uint32_t)(REJECTED + reason);
    made->program = (struct program){.generation = generation, .listener_count = 1,
                                     .listeners = &made->listener, .routes = &made->route};
    return made;
}

/* Free a program that nothing in the ring refers to. The receive thread may just be dropping such a message: it is done
 * with that a turn later. */
static void free_made(const struct round *env, struct made *made) {
    uint64_t turns = carrier_turns(env->carrier);
    while (carrier_turns(env->carrier) == turns) usleep(50);
    memset(made, 0, sizeof *made);
    free(made);
}

static struct made *replace_all(const struct round *env, struct made *running) {
    for (uint32_t generation = 2; generation <= PROGRAMS; generation++) {
        struct made *next = make(env, generation);
        struct change change = {.program = &next->program};
        carrier_change(env->carrier, &change);
        publish_advance(env->publishing, generation);
        __atomic_store_n(&demands[0].is_due, generation % 3 == 0, __ATOMIC_RELEASE);
        __atomic_store_n(&demands[0].wanted, generation % 5 ? 1 + generation % 2 : NOTHING, __ATOMIC_RELAXED);
        usleep(generation % 7 * 300);
        while (!publish_has_reached(env->publishing, generation)) usleep(100);
        free_made(env, running);
        running = next;
    }
    return running;
}

/* ---- other threads ---- */

static size_t make_datagram(uint32_t number, uint8_t *data) {
    size_t size = 3;
    for (data[0] = 0x0a, data[2] = 8; number > 0x7f; number >>= 7) data[size++] = (uint8_t)(number | 0x80);
    data[size++] = (uint8_t)number;
    data[1] = (uint8_t)(size - 2);
    return size;
}

static void *send_datagrams(void *of) {
    const struct round *env = of;
    int from = socket(AF_INET, SOCK_DGRAM, 0);
    struct sockaddr_in to;
    socklen_t length = sizeof to;
    getsockname(env->socket, (struct sockaddr *)&to, &length);
    for (uint32_t number = 1; !atomic_load(&has_ended); number++) {
        uint8_t data[8];
        sendto(from, data, make_datagram(number, data), 0, (struct sockaddr *)&to, sizeof to);
    }
    close(from);
    return NULL;
}

/* Whatever a topic no longer waits for has become of something. */
static void check_balance(const int64_t *counts) {
    for (int topic = 0; topic < TOPICS; topic++) {
        int64_t sum = counts[topic_counter(topic, WAITING)];
        for (int which = FILTERED; which <= REFUSED; which++) sum += counts[topic_counter(topic, which)];
        check(sum == 0, "each message that was served is counted once");
    }
}

static void *watch(void *of) {
    const struct round *env = of;
    static uint64_t records[4096];
    int64_t counts[COUNTERS];
    uint32_t topic;
    while (!atomic_load(&has_ended)) {
        if (publish_counters(env->publishing, counts, COUNTERS)) check_balance(counts);
        if (publish_since(env->publishing, &topic)) check(topic <= TOPICS, "it is a topic");
        carrier_pulse(env->carrier);
        ring_take(env->events, records, sizeof records, 1000000);
    }
    return NULL;
}

/* ---- rounds ---- */

static void open_env(struct round *env) {
    struct sockaddr_in any = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    env->received = calloc(COUNTERS, sizeof *env->received);
    env->published = calloc(COUNTERS, sizeof *env->published);
    env->events = ring_open(1 << 14);
    env->rejections = ring_open(1 << 12);
    env->messages = ring_open(QUEUE);
    env->timers = timers_open(env->received, env->rejections);
    env->carrier = carrier_open(env->timers, env->received, env->rejections, env->messages);
    env->socket = socket(AF_INET, SOCK_DGRAM, 0);
    check(!bind(env->socket, (struct sockaddr *)&any, sizeof any), "bind");
    env->publishing = publish_open(env->messages, env->published, env->events, publish, why, forget,
                                     NULL);
    check(env->publishing, "the thread starts");
}

static void close_env(struct round *env) {
    carrier_close(env->carrier);
    timers_close(env->timers);
    ring_close(env->messages);
    ring_close(env->events);
    ring_close(env->rejections);
    free(env->received);
    free(env->published);
    close(env->socket);
}

/* All that was received came to something. */
static void check_accounts(const struct round *env) {
    check_balance((const int64_t *)env->published);
    for (int topic = 0; topic < TOPICS; topic++) {
        int64_t sum = 0;
        for (int which = WAITING; which <= REFUSED; which++)
            sum += env->received[topic_counter(topic, which)] + env->published[topic_counter(topic, which)];
        check(sum == env->received[ACCEPTED], "each message is counted once");
        check(!(env->received[topic_counter(topic, WAITING)] + env->published[topic_counter(topic, WAITING)]),
              "nothing waits");
    }
}

/* Play a round. In some, the thread is stuck at the end, and left. */
static void play(int round) {
    struct round env;
    bool gets_stuck = round % 4 == 3;
    memset(latest, 0, sizeof latest);
    for (int topic = 0; topic < TOPICS; topic++) demands[topic] = (struct demand){.wanted = EVERY_MESSAGE};
    open_env(&env);
    struct made *first = make(&env, 1);
    struct change start = {.program = &first->program};
    check(!carrier_start(env.carrier, &start), "the carrier starts");
    pthread_t sending, watching;
    atomic_store(&has_ended, false);
    pthread_create(&sending, NULL, send_datagrams, &env);
    pthread_create(&watching, NULL, watch, &env);
    struct made *last = replace_all(&env, first);
    if (gets_stuck) {
        __atomic_store_n(&demands[0].wanted, EVERY_MESSAGE, __ATOMIC_RELAXED);
        atomic_store(&is_stuck, true);
        while (!atomic_load(&inside)) usleep(100);
    }
    usleep((unsigned)round * 100);
    atomic_store(&has_ended, true);
    pthread_join(sending, NULL);
    pthread_join(watching, NULL);
    carrier_stop_receiving(env.carrier);
    bool has_stopped = publish_stop(env.publishing);
    check(has_stopped == !gets_stuck, "it stops unless it is stuck");
    if (has_stopped) check_accounts(&env);
    else left[round] = env.publishing;
    printf("%lld received, %lld and %lld published\n", (long long)env.received[ACCEPTED],
           (long long)env.published[topic_counter(0, PUBLICATIONS)], (long long)env.published[topic_counter(1, PUBLICATIONS)]);
    close_env(&env);
    free(last);
    atomic_store(&is_stuck, false);
    while (atomic_load(&inside)) usleep(100);
    if (!has_stopped) usleep(20000); /* it finds that it was left */
}

int main(void) {
    for (int round = 0; round < ROUNDS; round++) play(round);
    return 0;
}
