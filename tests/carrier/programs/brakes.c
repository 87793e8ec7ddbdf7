/* Threads that send commands, brake, and replace deadmen at once. Fails if a command arrives behind a brake although it
 * had expired when the brake was due; sanitizers see the rest. The argument is how many commands each thread sends. */
#include <netinet/in.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "check.h"
#include "clock.h"
#include "deadman.h"

enum { COUNTERS = 16, ACTIVE = 0, TRIPS = 1, SENT = 2, ERRORS = 3, MOST_REPLACED = 200 };
enum kind { COMMAND = 1, BRAKE = 2 };
static const int64_t TIMEOUT = 1000000, REPEAT = 300000, TTL = 200000; /* ns */

struct datagram {
    int64_t kind, born, expires;
};
static const struct datagram brake = {BRAKE, 0, 0};

struct board {
    int fd;
    struct sender *sender;
};

static counter counters[COUNTERS];
static struct ring *events;
static struct timers *timers;
static struct board drive, spare;
static _Atomic(struct deadman *) acting;
static struct deadman *takes_over; /* of another route */
static _Atomic bool is_done;
static _Atomic int64_t stale, arrived, brakes;
static long commands;

static struct board open_board(void) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t length = sizeof address;
    struct timeval turn = {0, 20000};
    int board = socket(AF_INET, SOCK_DGRAM, 0), from = socket(AF_INET, SOCK_DGRAM, 0);
    check(!bind(board, (struct sockaddr *)&address, sizeof address), "bind");
    getsockname(board, (struct sockaddr *)&address, &length);
    setsockopt(board, SOL_SOCKET, SO_RCVTIMEO, &turn, sizeof turn);
    return (struct board){board, sender_open(from, -1, INADDR_LOOPBACK, ntohs(address.sin_port))};
}

static void close_board(struct board board) {
    close(board.sender->fd);
    sender_end(board.sender);
    sender_close(board.sender);
    close(board.fd);
}

static struct deadman *open_deadman(bool has_spare) {
    struct deadman_datagram datagram = {(const uint8_t *)&brake, sizeof brake};
    struct deadman_destination to[] = {
        {.sender = drive.sender, .datagrams = &datagram, .count = 1, .sent = SENT, .send_errors = ERRORS, .id = 7},
        {.sender = spare.sender, .datagrams = &datagram, .count = 1, .sent = SENT, .send_errors = ERRORS, .id = 8,
         .follows = 1}};
    return deadman_open(timers, TIMEOUT, REPEAT, true, ACTIVE, TRIPS, 1, to, has_spare ? 2 : 1);
}

/* Sends commands, most of them at once; a pause now and then lets a deadman trip, or the command get old. */
static void *send_commands(void *seed) {
    unsigned random = (unsigned)(uintptr_t)seed;
    for (long number = 0; number < commands; number++) {
        int64_t born = boottime_ns();
        struct datagram command = {COMMAND, born, born + TTL};
        struct feed feeds[] = {{.deadman = atomic_load(&acting), .to = 1},
                               {.deadman = takes_over, .to = 1, .disarms = 1}};
        if (rand_r(&random) % 50 == 0) usleep(150);
        int error = command_send(timers, drive.sender, &command, sizeof command, command.expires, feeds, 2);
        if (error == COMMAND_STALE) atomic_fetch_add(&stale, 1);
        else check(!error, "a command is sent");
        if (rand_r(&random) % 20 == 0) usleep(1500);
    }
    return NULL;
}

/* Commands of a route that the other one hands over to. They go elsewhere. */
static void *send_others(void *seed) {
    unsigned random = (unsigned)(uintptr_t)seed;
    for (long number = 0; number < commands / 4; number++) {
        struct feed feeds[] = {{.deadman = takes_over, .to = 1}};
        command_send(timers, spare.sender, "other", 5, NEVER, feeds, 1);
        if (rand_r(&random) % 2) usleep(700);
    }
    return NULL;
}

static void *wait_for_timer(void *unused) {
    while (!atomic_load(&is_done)) {
        struct pollfd waiting = {timers->timer, POLLIN, 0};
        if (poll(&waiting, 1, 20) > 0) timers_serve(timers, boottime_ns());
    }
    return unused;
}

/* As the receive thread does between two datagrams. */
static void *look_for_due(void *unused) {
    while (!atomic_load(&is_done)) {
        int64_t now = boottime_ns();
        if (atomic_load_explicit(&timers->wakes_at, memory_order_relaxed) <= now) timers_serve(timers, now);
        usleep(100);
    }
    return unused;
}

static void *replace(void *unused) {
    struct deadman *replaced[MOST_REPLACED];
    int count = 0;
    while (!atomic_load(&is_done) && count < MOST_REPLACED) {
        struct deadman *earlier = atomic_load(&acting), *next = open_deadman(count % 2);
        deadman_close(timers, open_deadman(true)); /* of a program that was abandoned */
        deadman_replace(timers, next, earlier);
        timer_end(timers, (struct timer *)earlier);
        atomic_store(&acting, next);
        replaced[count++] = earlier;
        usleep(3000);
    }
    while (!atomic_load(&is_done)) usleep(1000); /* somebody may feed them until then */
    for (int index = 0; index < count; index++) deadman_close(timers, replaced[index]);
    return unused;
}

static void *read_events(void *unused) {
    _Alignas(8) char records[4096];
    while (!atomic_load(&is_done)) {
        size_t size = ring_take(events, records, sizeof records, 20000000);
        for (size_t position = 0; position < size;) {
            struct deadman_event event;
            memcpy(&event, records + position, sizeof event);
            check(event.size == sizeof event && event.kind >= EVENT_TRIPPED && event.kind <= EVENT_DEADMAN_ERROR,
                  "events are whole");
            position += event.size;
        }
    }
    return unused;
}

/* The first brake of a silence left `TIMEOUT` after the command before it or later; a command behind it was fresh then. */
static void *receive(void *unused) {
    int64_t latest_born = 0, braked_since = 0;
    struct datagram datagram;
    for (;;) {
        ssize_t size = recv(drive.fd, &datagram, sizeof datagram, 0);
        if (size < 0 && atomic_load(&is_done)) return unused;
        if (size != sizeof datagram) continue;
        atomic_fetch_add(datagram.kind == BRAKE ? &brakes : &arrived, 1);
        if (datagram.kind == BRAKE) {
            braked_since = latest_born + TIMEOUT;
            continue;
        }
        check(datagram.expires >= braked_since, "no old command behind a brake");
        if (datagram.born > latest_born) latest_born = datagram.born;
    }
}

int main(int count, char **arguments) {
    check(count == 2, "one argument");
    commands = atol(arguments[1]);
    events = ring_open(512);
    timers = timers_open(counters, events);
    drive = open_board();
    spare = open_board();
    atomic_store(&acting, open_deadman(true));
    struct deadman_destination silent = {.sender = spare.sender};
    takes_over = deadman_open(timers, TIMEOUT, REPEAT, true, 4, 5, 2, &silent, 1);
    void *(*others[])(void *) = {wait_for_timer, look_for_due, replace, read_events, receive};
    void *(*senders[])(void *) = {send_commands, send_commands, send_others};
    enum { OTHERS = 5, SENDERS = 3 };
    pthread_t other[OTHERS], sending[SENDERS];
    for (int index = 0; index < OTHERS; index++) pthread_create(&other[index], NULL, others[index], NULL);
    for (uintptr_t index = 0; index < SENDERS; index++)
        pthread_create(&sending[index], NULL, senders[index], (void *)(index + 1));
    for (int index = 0; index < SENDERS; index++) pthread_join(sending[index], NULL);
    atomic_store(&is_done, true);
    for (int index = 0; index < OTHERS; index++) pthread_join(other[index], NULL);
    timer_end(timers, (struct timer *)atomic_load(&acting));
    deadman_close(timers, atomic_load(&acting));
    timer_end(timers, (struct timer *)takes_over);
    deadman_close(timers, takes_over);
    timers_serve(timers, 0);
    check(atomic_load(&timers->wakes_at) == NEVER, "nothing is due at the end");
    check(!counters[ERRORS], "all brakes are sent");
    check(arrived > 0 && brakes > 0 && counters[TRIPS] > 0, "commands and brakes arrive");
    timers_close(timers);
    ring_close(events);
    close_board(drive);
    close_board(spare);
    printf("arrived %lld, stale %lld, brakes %lld\n", (long long)arrived, (long long)stale, (long long)brakes);
    return 0;
}
