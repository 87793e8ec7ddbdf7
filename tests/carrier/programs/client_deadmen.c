/* Clients feed deadmen, subscribers come, tables are reloaded and the router stops, all at once, while publishing takes its
 * time: for sanitizers. Each deadman publishes at most as often as it is counted. Argument: how many reloads. */
#include <assert.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "client_deadmen.h"
#include "clock.h"
#include "deadman.h"

enum { ACTIVE, TRIPS, SENT, ERRORS, COUNTERS, TOPICS = 3 };

static counter counters[COUNTERS];
static _Atomic int published, refused;
static _Atomic bool is_over;
static struct client_deadmen *clients;
static struct deadman *acting[TOPICS];
static pthread_rwlock_t using = PTHREAD_RWLOCK_INITIALIZER; /* so that none goes while it is used */

static int publish(const void *publisher, const void *message, void *allocation) {
    const struct serialized_message *written = message;
    (void)allocation;
    assert(written->length == 4 && !memcmp(written->buffer, "stop", 4));
    usleep(200);
    if (publisher == &acting[0]) {
        atomic_fetch_add(&refused, 1);
        return 1;
    }
    atomic_fetch_add(&published, 1);
    return 0;
}

static struct error_text error_of(void) { return (struct error_text){"it refuses"}; }
static void forget_error(void) {}

static struct deadman *opened(int topic) {
    struct deadman_datagram stop = {(const uint8_t *)"stop", 4};
    struct deadman_destination to = {.datagrams = &stop, .count = 1, .sent = SENT, .send_errors = ERRORS,
                                     .publisher = &acting[topic]};
    struct deadman *made = deadman_open(client_deadmen_group(clients), 500000, 100000, true, ACTIVE, TRIPS, 1, &to, 1);
    assert(made);
    return made;
}

static void *feed(void *unused) {
    (void)unused;
    for (int turn = 0; !atomic_load(&is_over); turn++) {
        pthread_rwlock_rdlock(&using);
        deadman_feed(client_deadmen_group(clients), acting[turn % TOPICS], boottime_ns());
        pthread_rwlock_unlock(&using);
        if (turn % 50 == 0) usleep(1000);
    }
    return NULL;
}

static void *greet(void *unused) {
    (void)unused;
    for (int turn = 0; !atomic_load(&is_over); turn++) {
        pthread_rwlock_rdlock(&using);
        struct deadman *deadman = acting[turn % TOPICS];
        deadman_await_subscribers(client_deadmen_group(clients), deadman, boottime_ns());
        deadman_greet(client_deadmen_group(clients), deadman, boottime_ns());
        pthread_rwlock_unlock(&using);
        usleep(100);
    }
    return NULL;
}

int main(int count, char **arguments) {
    int reloads = count > 1 ? atoi(arguments[1]) : 100;
    struct ring *events = ring_open(1 << 14);
    pthread_t threads[2];
    clients = client_deadmen_open(counters, events);
    assert(clients && !client_deadmen_start(clients, publish, error_of, forget_error));
    struct timers *group = client_deadmen_group(clients);
    for (int topic = 0; topic < TOPICS; topic++) acting[topic] = opened(topic);
    pthread_create(&threads[0], NULL, feed, NULL);
    pthread_create(&threads[1], NULL, greet, NULL);
    for (int turn = 1; turn <= reloads; turn++) {
        int topic = turn % TOPICS;
        struct deadman *earlier = acting[topic], *next = opened(topic);
        if (turn % 5) deadman_replace(group, next, earlier);
        else deadman_end_by_thread(group, earlier);
        deadman_feed(group, earlier, boottime_ns());
        pthread_rwlock_wrlock(&using);
        acting[topic] = next;
        pthread_rwlock_unlock(&using);
        client_deadmen_advance(clients, (uint32_t)turn);
        while (!client_deadmen_have_reached(clients, (uint32_t)turn)) usleep(100);
        deadman_close(group, earlier);
    }
    atomic_store(&is_over, true);
    for (int each = 0; each < 2; each++) pthread_join(threads[each], NULL);
    assert(client_deadmen_stop(clients));
    assert(atomic_load(&counters[SENT]) == atomic_load(&published));
    assert(atomic_load(&counters[ERRORS]) == atomic_load(&refused));
    assert(atomic_load(&published) > 0 && atomic_load(&refused) > 0);
    printf("%d published, %d refused, %ld trips\n", atomic_load(&published), atomic_load(&refused),
           (long)atomic_load(&counters[TRIPS]));
    return 0;
}
