/* Programs that replace each other without a pause while datagrams, commands and brakes are under way. The argument is
 * how many programs there are. Fails unless everything that was sent is found in the counters at the end, and the
 * counters balance at any moment; sanitizers see the rest. A program is freed as soon as nobody can use it. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "carrier.h"
#include "check.h"
#include "clock.h"

enum {
    LISTENERS = 3, ROUTES = 2, BOARDS = 2, DESTINATIONS = 3, /* boards, and one that refuses */
    MOST_ON_THE_WAY = 60, /* datagrams: the least receive buffer holds them */
    HISTOGRAM = 14, MOST_LEFT = 4,
};
/* Counters. Those of listeners, routes and destinations are each a block. */
enum { OF_LISTENER = 4 + REASONS, OF_DESTINATION = 6, OF_ROUTE = 5 + HISTOGRAM + DESTINATIONS * OF_DESTINATION };
enum { RECEIVED, BYTES, PADDED, SUPERSEDED, REJECTED };
enum { SENT, SENT_BYTES, STALE, LIMITED, FULL, ERROR };
enum { KNOWN, STRANGERS, WAITING, QUEUE_FULL, FILTERED, LAST };
enum {
    LISTENER_COUNTERS = 0,
    ROUTE_COUNTERS = LISTENER_COUNTERS + LISTENERS * OF_LISTENER,
    OTHER_COUNTERS = ROUTE_COUNTERS + ROUTES * (OF_ROUTE + 1),
    UNKNOWN = OTHER_COUNTERS, UNHANDLED_CASE, SEEN, HEARD, MIRROR_LOST, COUNTERS
};
enum { ACTIVE, TRIPS, BRAKES, BRAKE_ERRORS, DEADMAN_COUNTERS };

/* All that a program refers to. */
struct made {
    struct program program;
    struct listener listeners[LISTENERS];
    struct choice choices[ROUTES * 2]; /* columns: the known peer, strangers */
    struct peer peer;
    struct payload_case cases[ROUTES + 1];
    struct protocol protocol;
    struct route routes[ROUTES];
    struct target destinations[ROUTES][DESTINATIONS];
    struct section section; /* of which no field is wanted */
    struct value defaults[SLOT_SOURCE + 1], sources[2];
    struct layout layout;
    struct operation condition;
    struct topic topic;
    struct target topics[ROUTES];
    struct feed feed;
    bool has_been_left;  /* by the threads that take and command, */
    uint64_t turns;      /* when the receive thread had done so many turns */
};

static const struct wire_field of_envelope[] = {
    {1, WIRE_MESSAGE, WIRE_CASE | WIRE_ROUTED, 1}, {2, WIRE_MESSAGE, WIRE_CASE | WIRE_ROUTED, 1},
    {3, WIRE_MESSAGE, WIRE_CASE, 1}};
static const struct wire_type types[] = {{of_envelope, 3, 0}, {NULL, 0, 1}};

static counter counters[COUNTERS], braked[DEADMAN_COUNTERS];
static struct ring *receive_events, *brake_events, *messages, *mirrored;
static struct timers *timers;
static struct carrier *carrier;
static struct limit limit = {1000000, 500000, -1000000};
static struct limit *const limits[] = {&limit, &limit}; /* columns */
static int listening[LISTENERS], boards[BOARDS], sending[DESTINATIONS];
static struct sender *senders[DESTINATIONS];
static _Atomic int64_t sent[LISTENERS], taken, commands;
static _Atomic uint32_t latest, reader_at, commander_at; /* generations */
static _Atomic(struct deadman *) acting;
static _Atomic bool is_quiet, has_ended; /* nobody sends; nobody reads either */
static struct demand demand;

/* ---- sockets ---- */

static struct sockaddr_in loopback(uint32_t last, uint16_t port) {
    return (struct sockaddr_in){
        .sin_family = AF_INET, .sin_addr.s_addr = htonl(0x7f000000 + last), .sin_port = htons(port)};
}

static int bound(uint32_t last) {
    int fd = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0), on = 1;
    struct sockaddr_in address = loopback(last, 0);
    setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
    check(!bind(fd, (struct sockaddr *)&address, sizeof address), "bind");
    return fd;
}

static struct sockaddr_in address_of(int fd) {
    struct sockaddr_in address;
    socklen_t length = sizeof address;
    getsockname(fd, (struct sockaddr *)&address, &length);
    return address;
}

static void open_sender(int index, struct sockaddr_in to) {
    int on = 1;
    sending[index] = bound(1);
    setsockopt(sending[index], IPPROTO_IP, IP_RECVERR, &on, sizeof on);
    senders[index] = sender_open(sending[index], -1, INADDR_LOOPBACK, ntohs(to.sin_port));
}

/* ---- programs ---- */

static uint32_t listener_counter(int listener, int which) {
    return (uint32_t)(LISTENER_COUNTERS + listener * OF_LISTENER + which);
}

static uint32_t route_counter(int route, int which) { return (uint32_t)(ROUTE_COUNTERS + route * (OF_ROUTE + 1) + which); }

static uint32_t destination_counter(int route, int destination, int which) {
    return route_counter(route, LAST + 1 + HISTOGRAM + destination * OF_DESTINATION + which);
}

static struct listener make_listener(const struct made *made, int index) {
    struct listener listener = {.fd = listening[index], .id = (uint32_t)index, .repairs = 1, .protocol = &made->protocol,
                                .peers = &made->peer, .choices = made->choices, .peer_count = 1, .columns = 2,
                                .received = listener_counter(index, RECEIVED),
                                .received_bytes = listener_counter(index, BYTES),
                                .padded = listener_counter(index, PADDED),
                                .superseded = listener_counter(index, SUPERSEDED)};
    for (int reason = 0; reason < REASONS; reason++)
        listener.rejected[reason] = listener_counter(index, REJECTED + reason);
    return listener;
}

static struct target make_destination(const struct made *made, int route, int to) {
    struct target target = {
        .sender = senders[to], .limits = to == 1 ? limits : NULL, .feeds = &made->feed, .feed_count = to == 0,
        .is_ordered = to == 0, .condition = {&made->condition, to == 1, 0}, .trims = to == 1, .id = (uint32_t)to,
        .delivered = destination_counter(route, to, SENT), .delivered_bytes = destination_counter(route, to, SENT_BYTES)};
    target.dropped[DROP_STALE] = destination_counter(route, to, STALE);
    target.dropped[DROP_RATE_LIMITED] = destination_counter(route, to, LIMITED);
    target.dropped[DROP_SEND_BUFFER_FULL] = destination_counter(route, to, FULL);
    target.dropped[DROP_SEND_ERROR] = destination_counter(route, to, ERROR);
    return target;
}

static void make_route(struct made *made, int index) {
    for (int to = 0; to < DESTINATIONS; to++) made->destinations[index][to] = make_destination(made, index, to);
    made->topics[index] = (struct target){.topic = &made->topic, .id = 7, .waiting = route_counter(index, WAITING),
                                          .filtered = route_counter(index, FILTERED)};
    made->topics[index].dropped[DROP_QUEUE_FULL] = route_counter(index, QUEUE_FULL);
    struct targets sends = {.ttl = index ? 20000000 : 0, .layout = &made->layout, .sources = made->sources,
                            .targets = made->destinations[index], .count = DESTINATIONS, .route = (uint32_t)index,
                            .topic = NO_NAME};
    made->routes[index] = (struct route){.sends = sends,
                                         .publishes = {.targets = &made->topics[index], .count = 1,
                                                       .route = (uint32_t)index},
                                         .last_message = route_counter(index, LAST),
                                         .duration = route_counter(index, LAST + 1)};
    made->cases[index] = (struct payload_case){.number = (uint32_t)index + 1, .row = index, .unhandled = UNHANDLED_CASE};
    made->choices[2 * index] = (struct choice){index, route_counter(index, KNOWN)};
    made->choices[2 * index + 1] = (struct choice){index ? -1 : 0, route_counter(index, STRANGERS)};
}

static struct deadman *open_deadman(void) {
    struct deadman_datagram brake = {(const uint8_t *)"brake", 5};
    struct deadman_destination to = {
        .sender = senders[0], .datagrams = &brake, .count = 1, .sent = BRAKES, .send_errors = BRAKE_ERRORS};
    return deadman_open(timers, 2000000, 500000, true, ACTIVE, TRIPS, 1, &to, 1);
}

/* A program with one, two or three listeners, in turns: each is missing now and then. */
static struct made *make(uint32_t generation) {
    struct made *made = calloc(1, sizeof *made);
    check(made, "memory");
    made->topic.demand = &demand;
    made->feed.deadman = open_deadman();
    made->layout = (struct layout){.sections = &made->section, .defaults = made->defaults, .slot_count = SLOT_SOURCE + 1};
    made->condition = (struct operation){.kind = OP_INTEGER, .integer = 1};
    made->peer = (struct peer){.address = 0x7f000002, .last_seen = SEEN, .heard_since = HEARD, .pause = INT64_MAX};
    made->cases[ROUTES] = (struct payload_case){.number = ROUTES + 1, .row = -1, .unhandled = UNHANDLED_CASE};
    for (int index = 0; index < ROUTES; index++) make_route(made, index);
    made->protocol = (struct protocol){.schema = {.types = types, .count = 2}, .cases = made->cases,
                                       .case_count = ROUTES + 1, .unknown_case = UNKNOWN};
    made->program = (struct program){.generation = generation, .listener_count = 1 + generation % LISTENERS,
                                     .listeners = made->listeners, .routes = made->routes};
    for (uint32_t index = 0; index < made->program.listener_count; index++)
        made->listeners[index] = make_listener(made, (int)((index + generation / 2) % LISTENERS));
    return made;
}

static void free_made(struct made *made) {
    deadman_close(timers, made->feed.deadman);
    free(made);
}

static void change(const struct made *next, const struct made *earlier) {
    struct deadman *replaced[] = {next->feed.deadman, earlier->feed.deadman};
    struct timer *ended[] = {(struct timer *)earlier->feed.deadman};
    struct change change = {.program = &next->program, .replaced = replaced, .replaced_count = 1,
                            .timers = {.ended = ended, .ended_count = 1}};
    carrier_change(carrier, &change);
    atomic_store(&acting, next->feed.deadman);
    atomic_store(&latest, next->program.generation);
}

/* Whether nobody uses a program any more that another one has replaced. Until its next turn the receive thread may be
 * dropping a message of it. */
static bool has_passed(struct made *made) {
    uint32_t next_one = made->program.generation + 1;
    if (atomic_load(&reader_at) < next_one || atomic_load(&commander_at) < next_one) return false;
    if (!made->has_been_left) made->turns = carrier_turns(carrier);
    made->has_been_left = true;
    return carrier_turns(carrier) != made->turns;
}

/* Replace programs, and free those that nobody uses: they may be as many as MOST_LEFT. Return the last one, which has
 * all listeners. */
static struct made *replace_all(struct made *running, uint32_t count) {
    struct made *left[MOST_LEFT];
    uint32_t first = 0, end = 0;
    for (uint32_t generation = 2; generation <= count; generation++) {
        struct made *next = make(generation);
        free_made(make(generation)); /* one that is abandoned */
        change(next, running);
        left[end++ % MOST_LEFT] = running;
        running = next;
        carrier_mirror(carrier, generation % 3 ? mirrored : NULL, MIRROR_LOST);
        __atomic_store_n(&demand.wanted, generation % 2, __ATOMIC_RELAXED);
        usleep(generation % 7 * 300);
        for (; first < end; first++) {
            struct made *oldest = left[first % MOST_LEFT];
            while (end - first == MOST_LEFT && !has_passed(oldest)) usleep(100);
            if (!has_passed(oldest)) break;
            free_made(oldest);
        }
    }
    atomic_store(&is_quiet, true);
    while (atomic_load(&commander_at) != UINT32_MAX) usleep(100);
    while (atomic_load(&reader_at) < running->program.generation) usleep(100);
    for (; first < end; first++) {
        while (!has_passed(left[first % MOST_LEFT])) usleep(100);
        free_made(left[first % MOST_LEFT]);
    }
    struct made *last = make(LISTENERS * count + LISTENERS - 1);
    change(last, running);
    while (atomic_load(&reader_at) < last->program.generation || !has_passed(running)) usleep(100);
    free_made(running);
    return last;
}

/* ---- other threads ---- */

static size_t make_datagram(unsigned *random, uint8_t *data) {
    static const uint8_t forms[][6] = {{0x0a, 2, 8, 1}, {0x12, 2, 8, 1}, {0x1a, 2, 8, 1}, {0x0a, 2, 8, 0},
                                       {0x12, 3, 8, 0, 0, 0}, {0x0a, 9, 9, 9}, {0xff, 0xff}, {0x22, 1, 1}};
    unsigned form = (unsigned)rand_r(random) % 8;
    memcpy(data, forms[form], sizeof forms[form]);
    return (unsigned)rand_r(random) % 10 ? 4 : (unsigned)rand_r(random) % 7;
}

/* Sends to all listeners, as the known peer or as a stranger, without more on the way than the kernel holds. */
static void *send_datagrams(void *of) {
    unsigned random = (unsigned)(uintptr_t)of;
    int from = bound((uint32_t)(uintptr_t)of);
    for (int listener = 0; !atomic_load(&is_quiet); listener = (listener + 1) % LISTENERS) {
        uint8_t data[8];
        if (atomic_load(&sent[listener]) - atomic_load(&counters[listener_counter(listener, RECEIVED)]) > MOST_ON_THE_WAY) {
            usleep(200);
            continue;
        }
        struct sockaddr_in to = address_of(listening[listener]);
        size_t size = make_datagram(&random, data);
        atomic_fetch_add(&sent[listener], 1);
        check(sendto(from, data, size, 0, (struct sockaddr *)&to, sizeof to) == (ssize_t)size, "sendto");
    }
    close(from);
    return NULL;
}

static void *send_commands(void *unused) {
    while (!atomic_load(&is_quiet)) {
        atomic_store(&commander_at, atomic_load(&latest));
        struct feed feed = {.deadman = atomic_load(&acting), .to = 1};
        int error = command_send(timers, senders[0], "command", 7, NEVER, &feed, 1);
        check(!error, "a command is sent");
        atomic_fetch_add(&commands, 1);
        usleep(atomic_load(&commands) % 20 ? 200 : 5000);
    }
    atomic_store(&commander_at, UINT32_MAX);
    return unused;
}

/* Takes messages as the publish thread does, and looks at the targets of each, at times slowly. */
static void *read_messages(void *unused) {
    static uint64_t records[2048];
    for (uint32_t turn = 0; !atomic_load(&has_ended) || messages->written != messages->taken; turn++) {
        uint32_t now_at = atomic_load(&latest);
        size_t size = ring_take(messages, records, sizeof records, 1000000);
        for (size_t at = 0; at < size;) {
            const struct message_record *record = (const struct message_record *)(const void *)((char *)records + at);
            check(record->to->targets->id == 7, "the targets are alive");
            check(record->generation >= atomic_load(&reader_at), "generations come in order");
            atomic_store(&reader_at, record->generation);
            atomic_fetch_add(&taken, 1);
            at += record->size;
        }
        if (!size) atomic_store(&reader_at, now_at);
        if (turn % 8 == 0) usleep(4000);
    }
    return unused;
}

static void *read_others(void *unused) {
    static uint64_t records[4096];
    while (!atomic_load(&has_ended)) {
        ring_take(mirrored, records, sizeof records, 1000000);
        ring_take(receive_events, records, sizeof records, 0);
        ring_take(brake_events, records, sizeof records, 0);
        for (int board = 0; board < BOARDS; board++)
            while (recv(boards[board], records, sizeof records, MSG_DONTWAIT) >= 0) {}
    }
    return unused;
}

/* ---- accounts ---- */

/* Return how many datagrams of a listener were rejected. */
static int64_t rejected(const int64_t *counts) {
    int64_t sum = 0;
    for (int listener = 0; listener < LISTENERS; listener++)
        for (int reason = 0; reason < REASONS; reason++) sum += counts[listener_counter(listener, REJECTED + reason)];
    return sum;
}

static void check_balance(const int64_t *counts) {
    int64_t received = 0, accepted = 0;
    for (int listener = 0; listener < LISTENERS; listener++) received += counts[listener_counter(listener, RECEIVED)];
    for (int route = 0; route < ROUTES; route++) {
        int64_t of_route = counts[route_counter(route, KNOWN)] + counts[route_counter(route, STRANGERS)], timed = 0;
        accepted += of_route;
        for (int to = 0; to < DESTINATIONS; to++) {
            int64_t fates = 0;
            for (int which = SENT; which <= ERROR; which++)
                if (which != SENT_BYTES) fates += counts[destination_counter(route, to, which)];
            check(fates == of_route, "each message to a destination is counted once");
        }
        int64_t of_topic = counts[route_counter(route, WAITING)] + counts[route_counter(route, QUEUE_FULL)] +
                          counts[route_counter(route, FILTERED)];
        check(of_topic == of_route, "each message for a topic is counted once");
        for (int cell = 0; cell < HISTOGRAM - 1; cell++) timed += counts[route_counter(route, LAST + 1 + cell)];
        check(timed == of_route, "each message is timed once");
    }
    check(received == accepted + rejected(counts), "each datagram is accepted or rejected");
}

static void *watch_counters(void *unused) {
    int64_t counts[COUNTERS];
    while (!atomic_load(&has_ended)) {
        if (carrier_counters(carrier, counts, COUNTERS)) check_balance(counts);
        carrier_pulse(carrier);
        usleep(500);
    }
    return unused;
}

static void check_accounts(void) {
    int64_t counts[COUNTERS], waiting = 0, dropped = 0;
    check(carrier_counters(carrier, counts, COUNTERS), "the counters stand still");
    check_balance(counts);
    for (int listener = 0; listener < LISTENERS; listener++)
        check(counts[listener_counter(listener, RECEIVED)] == atomic_load(&sent[listener]), "all that was sent is received");
    for (int route = 0; route < ROUTES; route++) {
        waiting += counts[route_counter(route, WAITING)];
        dropped += counts[route_counter(route, QUEUE_FULL)];
        check(counts[destination_counter(route, 0, SENT)] > 0, "a board gets datagrams");
        check(counts[destination_counter(route, 2, ERROR)] > 0, "one refuses");
    }
    check(waiting == atomic_load(&taken), "all that waited was taken");
    check(dropped > 0, "the queue was full at times");
    check(braked[TRIPS] > 0 && braked[BRAKES] > 0 && !braked[BRAKE_ERRORS], "brakes are sent");
    printf("%lld datagrams for topics, %lld commands, %lld brakes\n", (long long)atomic_load(&taken),
           (long long)atomic_load(&commands), (long long)braked[BRAKES]);
}

int main(int count, char **arguments) {
    check(count == 2, "one argument");
    receive_events = ring_open(1 << 16);
    brake_events = ring_open(1 << 16);
    messages = ring_open(1 << 12);
    mirrored = ring_open(1 << 12);
    timers = timers_open(braked, brake_events);
    for (int index = 0; index < LISTENERS; index++) listening[index] = bound(1);
    for (int index = 0; index < BOARDS; index++) open_sender(index, address_of(boards[index] = bound(1)));
    int gone = bound(1);
    open_sender(BOARDS, address_of(gone));
    close(gone);
    carrier = carrier_open(timers, counters, receive_events, messages);
    struct made *first = make(1);
    struct change start = {.program = &first->program};
    atomic_store(&acting, first->feed.deadman);
    atomic_store(&latest, 1);
    check(!carrier_start(carrier, &start), "it starts");
    void *(*runs[])(void *) = {send_datagrams, send_datagrams, send_commands, read_messages, read_others, watch_counters};
    enum { SENDERS = 3, THREADS = 6 };
    pthread_t threads[THREADS];
    for (uintptr_t index = 0; index < THREADS; index++)
        pthread_create(&threads[index], NULL, runs[index], (void *)(index + 2));
    struct made *last = replace_all(first, (uint32_t)atoi(arguments[1]));
    for (int index = 0; index < SENDERS; index++) pthread_join(threads[index], NULL);
    carrier_stop_receiving(carrier);
    atomic_store(&has_ended, true);
    for (int index = SENDERS; index < THREADS; index++) pthread_join(threads[index], NULL);
    check_accounts();
    timer_end(timers, (struct timer *)last->feed.deadman);
    carrier_close(carrier);
    free_made(last);
    for (int index = 0; index < DESTINATIONS; index++) {
        close(sending[index]);
        sender_close(senders[index]);
    }
    timers_close(timers);
    ring_close(receive_events);
    ring_close(brake_events);
    ring_close(messages);
    ring_close(mirrored);
    return 0;
}
