#include "carrier.h"

#include <errno.h>
#include <linux/sockios.h>
#include <poll.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include "clock.h"
#include "hosts.h"
#include "priority.h"
#include "route.h"
#include "threads.h"

static const int64_t PYTHON_TIMEOUT = 30000000000; /* in ns: how long the watchdog is fed while Python is stuck */
static const char ALIVE[] = "WATCHDOG=1";

enum {
    TURN_MS = 50,              /* the longest wait for a datagram */
    MOST_DRAINED = 1 << 16,    /* datagrams: more than a receive buffer holds */
    LISTENERS_PER_WAIT = 16,
};

struct carrier {
    /* For the receive thread only: */
    struct share share;
    int epoll;
    /* Shared: */
    edition edition; /* of the counters */
    _Atomic(struct ring *) mirror;
    _Atomic uint32_t mirror_lost; /* counter */
    _Atomic(const struct change *) next, adopted;
    _Atomic bool is_stopping, is_closing;
    _Atomic uint64_t turns;
    _Atomic int64_t pulse; /* the last sign of life of Python, monotonic */
    /* For the timer thread: */
    _Atomic int notify; /* a socket, or -1 */
    _Atomic int64_t interval;
    int wake; /* eventfd */
    uint64_t turns_seen;
    pthread_t receiving, timing;
    bool has_started, has_stopped;
    struct routing routing; /* also for the receive thread; last, as it is large */
};

/* ---- the mirror ---- */

/* Copy a datagram to the mirror. `reason` is ROUTED, or the reason for rejecting the datagram. */
static void mirror(struct carrier *carrier, struct ring *to, const struct received *received, int reason) {
    struct mirror_record *record = (struct mirror_record *)carrier->routing.record;
    size_t kept = received->length < MAX_DATAGRAM + 1 ? received->length : MAX_DATAGRAM + 1;
    *record = (struct mirror_record){.size = padded_to_word(sizeof *record + kept),
                                     .listener = received->listener->id,
                                     .at = received->received_at,
                                     .address = received->address,
                                     .port = received->port,
                                     .length = (uint32_t)kept,
                                     .reason = reason,
                                     .endpoint = received->peer ? (int32_t)received->peer->id : STRANGER};
    memcpy(record + 1, carrier->routing.datagram, kept);
    uint32_t lost = atomic_load_explicit(&carrier->mirror_lost, memory_order_relaxed);
    if (!ring_put(to, record, record->size)) env_count(&carrier->routing.env, lost, 1);
}

/* ---- receiving ---- */

static int64_t nanoseconds(struct timespec time) { return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec; }

/* The wall-clock time at which the last received datagram arrived in the kernel; 0 if unknown. If the time does not come with
 * each datagram, as in qemu-user, an ioctl returns it. */
static int64_t arrival(int fd, struct msghdr *message) {
    struct timespec stamp;
    for (struct cmsghdr *each = CMSG_FIRSTHDR(message); each; each = CMSG_NXTHDR(message, each))
        if (each->cmsg_level == SOL_SOCKET && each->cmsg_type == SCM_TIMESTAMPNS) {
            memcpy(&stamp, CMSG_DATA(each), sizeof stamp);
            return nanoseconds(stamp);
        }
    return ioctl(fd, SIOCGSTAMPNS, &stamp) ? 0 : nanoseconds(stamp);
}

/* Like recvmsg, but errors about datagrams sent from the listener's port go to their senders, and do not delay received
 * datagrams. While more errors arrive, each attempt may fail. */
static ssize_t receive(int fd, struct msghdr *message, int flags) {
    enum { ATTEMPTS = 3 };
    ssize_t length = recvmsg(fd, message, flags);
    if (length >= 0 || errno == EAGAIN || errno == EINTR) return length;
    bool is_about_sent = sender_note_errors(fd);
    for (int left = ATTEMPTS; left; left--) {
        length = recvmsg(fd, message, flags | MSG_DONTWAIT);
        if (length >= 0 || errno == EAGAIN) return length;
    }
    int error = errno;
    if (!is_about_sent) usleep(1000); /* another error: avoid a busy loop */
    errno = error;
    return length;
}

/* Record that the queues were empty: no later datagram was stamped under a past setting of the clock. */
static void found_empty(struct carrier *carrier) {
    freshness_forget_past(&carrier->routing.freshness);
    int64_t now = boottime_ns();
    freshness_look(&carrier->routing.freshness, wall_ns(), now);
}

static void handle(struct carrier *carrier, struct received *received) {
    edition_begin(&carrier->edition);
    received->now = boottime_ns();
    received->received_at = wall_ns();
    int reason = route_datagram(&carrier->routing, received);
    if (received->route)
        count_duration(carrier->routing.env.counters, received->route->duration, LATENCY, boottime_ns() - received->now);
    struct ring *observed = atomic_load_explicit(&carrier->mirror, memory_order_acquire);
    if (observed) mirror(carrier, observed, received, reason);
    edition_end(&carrier->edition);
}

static void reject_frame(struct carrier *carrier, struct received *received, enum reason reason) {
    edition_begin(&carrier->edition);
    route_bad_frame(&carrier->routing, received, reason);
    edition_end(&carrier->edition);
}

enum outcome { RECEIVED, FOUND_EMPTY, RECEIVE_FAILED };

/* Receive and handle a datagram if there is one. */
static enum outcome receive_one(struct carrier *carrier, const struct listener *listener, int flags) {
    union socket_address sender;
    union { struct cmsghdr aligned; char bytes[CMSG_SPACE(sizeof(struct timespec))]; } control;
    struct iovec into = {carrier->routing.datagram, MAX_DATAGRAM + 1};
    struct msghdr message = {.msg_name = &sender, .msg_namelen = sizeof sender, .msg_iov = &into, .msg_iovlen = 1,
                             .msg_control = &control, .msg_controllen = sizeof control};
    ssize_t length = receive(listener->fd, &message, flags | MSG_TRUNC); /* returns the true length */
    if (length < 0) return errno == EAGAIN ? FOUND_EMPTY : RECEIVE_FAILED;
    if (!message.msg_namelen) { /* end of input; an empty datagram has a sender */
        if (!(flags & MSG_DONTWAIT)) usleep(1000);
        return FOUND_EMPTY;
    }
    struct received received = {.listener = listener, .length = (size_t)length, .arrived_at = arrival(listener->fd, &message),
                                .address = host_number(&sender), .port = host_port(&sender)};
    handle(carrier, &received);
    share_processor(&carrier->share, received.now);
    return RECEIVED;
}

static void serve_due(struct carrier *carrier) {
    int64_t due = atomic_load_explicit(&carrier->routing.env.timers->wakes_at, memory_order_relaxed);
    if (due == NEVER) return;
    int64_t now = boottime_ns();
    if (due <= now) timers_serve(carrier->routing.env.timers, now);
}

/* Read from a link, and handle the frames that are complete. A frame is as old as its first byte. */
static void receive_frames(struct carrier *carrier, const struct listener *listener) {
    enum framed framed;
    size_t length = 0;
    int64_t began;
    link_serve(listener->link);
    while ((framed = link_next(listener->link, carrier->routing.datagram, &length, &began)) != FRAME_PARTIAL) {
        struct received received = {.listener = listener, .length = length, .address = link_host(listener->link),
                                    .arrived_at = wall_ns() - (boottime_ns() - began)};
        if (framed == FRAME_READY) handle(carrier, &received);
        else reject_frame(carrier, &received, framed == FRAME_BAD ? BAD_FRAME : BAD_CHECKSUM);
        share_processor(&carrier->share, received.now);
        serve_due(carrier);
    }
}

static void drain(struct carrier *carrier, const struct listener *listener) {
    if (listener->link) return; /* what waits in a stream is not delivered late */
    for (int left = MOST_DRAINED; left && receive_one(carrier, listener, MSG_DONTWAIT) == RECEIVED; left--)
        serve_due(carrier);
}

/* ---- changes of the program ---- */

static bool has_listener(const struct program *program, int fd) {
    for (uint32_t index = 0; index < program->listener_count; index++)
        if (program->listeners[index].fd == fd) return true;
    return false;
}

static void adopt(struct carrier *carrier, const struct change *change) {
    const struct program *earlier = carrier->routing.program;
    if (earlier)
        for (uint32_t index = 0; index < earlier->listener_count; index++)
            if (!has_listener(change->program, earlier->listeners[index].fd)) drain(carrier, &earlier->listeners[index]);
    struct timeval turn = {0, TURN_MS * 1000};
    for (uint32_t index = 0; index < change->program->listener_count; index++)
        setsockopt(change->program->listeners[index].fd, SOL_SOCKET, SO_RCVTIMEO, &turn, sizeof turn);
    routing_adopt(&carrier->routing, change);
    atomic_store(&carrier->adopted, change);
}

/* Adopt the next program if there is one. The caller must no longer use the earlier one, whose memory may be freed. */
static void adopt_next(struct carrier *carrier) {
    const struct change *next = atomic_exchange(&carrier->next, NULL);
    if (next) adopt(carrier, next);
}

static bool is_stopping(struct carrier *carrier) {
    return atomic_load_explicit(&carrier->is_stopping, memory_order_relaxed);
}

static bool goes_on(struct carrier *carrier) {
    serve_due(carrier);
    /* Release order: a thread that sees the next turn may free memory that was read in this one. */
    atomic_fetch_add_explicit(&carrier->turns, 1, memory_order_release);
    return !is_stopping(carrier) && !atomic_load_explicit(&carrier->next, memory_order_relaxed);
}

/* Receive with one system call per datagram, which blocks unless the clock was set since the queue was empty. */
static void receive_from_one(struct carrier *carrier) {
    const struct listener *listener = carrier->routing.program->listeners;
    do {
        int flags = carrier->routing.freshness.count ? MSG_DONTWAIT : 0;
        if (receive_one(carrier, listener, flags) == FOUND_EMPTY) found_empty(carrier);
    } while (goes_on(carrier));
}

static int waited_for(const struct listener *listener) {
    return listener->link ? link_ready(listener->link) : listener->fd;
}

/* In each turn receive one datagram from each listener that has any, so that no listener starves the others. */
static void receive_from_many(struct carrier *carrier, int waiting) {
    const struct program *program = carrier->routing.program;
    for (uint32_t index = 0; index < program->listener_count; index++) {
        struct epoll_event interest = {.events = EPOLLIN, .data.u32 = index};
        epoll_ctl(waiting, EPOLL_CTL_ADD, waited_for(&program->listeners[index]), &interest);
    }
    do {
        struct epoll_event ready[LISTENERS_PER_WAIT];
        int turn = carrier->routing.freshness.count ? 0 : TURN_MS;
        int count = epoll_wait(waiting, ready, LISTENERS_PER_WAIT, turn), empty = 0;
        bool has_noted = false;
        for (int index = 0; index < count; index++) {
            const struct listener *listener = &program->listeners[ready[index].data.u32];
            if (listener->link) {
                receive_frames(carrier, listener);
                continue;
            }
            if (ready[index].events & EPOLLERR) has_noted |= sender_note_errors(listener->fd);
            empty += receive_one(carrier, listener, MSG_DONTWAIT) == FOUND_EMPTY;
        }
        if (count > 0 && empty == count && !has_noted) usleep(1000); /* end of input, which epoll reports again and again */
        if (count >= 0 && empty == count && count < LISTENERS_PER_WAIT) found_empty(carrier);
    } while (goes_on(carrier));
    for (uint32_t index = 0; index < program->listener_count; index++)
        epoll_ctl(waiting, EPOLL_CTL_DEL, waited_for(&program->listeners[index]), NULL);
}

static bool has_one_socket(const struct program *program) {
    return program->listener_count == 1 && !program->listeners->link;
}

static void *receive_thread(void *of) {
    struct carrier *carrier = of;
    carrier->share.may_be_first = carrier->share.is_first = run_first();
    while (!is_stopping(carrier)) {
        if (has_one_socket(carrier->routing.program)) receive_from_one(carrier);
        else receive_from_many(carrier, carrier->epoll);
        adopt_next(carrier);
    }
    const struct program *last = carrier->routing.program;
    for (uint32_t index = 0; index < last->listener_count; index++)
        if (!last->listeners[index].keeps_input) drain(carrier, &last->listeners[index]);
    return NULL;
}

/* ---- the timer thread ---- */

/* Feed the service manager's watchdog while receiving makes progress and Python is alive. */
static void feed_watchdog(struct carrier *carrier) {
    uint64_t turns = carrier_turns(carrier);
    if (turns == carrier->turns_seen || monotonic_ns() - atomic_load(&carrier->pulse) > PYTHON_TIMEOUT) return;
    carrier->turns_seen = turns;
    send(atomic_load(&carrier->notify), ALIVE, sizeof ALIVE - 1, MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* Return the time until the watchdog's next turn, in ms for `poll`. */
static int until_turn(struct carrier *carrier, int64_t turn) {
    if (atomic_load(&carrier->notify) < 0) return -1;
    int64_t wait = turn - monotonic_ns();
    return wait > 0 ? (int)(wait / 1000000) + 1 : 0;
}

/* Serves timers while nothing is received, and the watchdog. */
static void *timer_thread(void *of) {
    struct carrier *carrier = of;
    int64_t turn = 0;
    run_first();
    while (!atomic_load(&carrier->is_closing)) {
        struct pollfd waiting[] = {{carrier->routing.env.timers->timer, POLLIN, 0}, {carrier->wake, POLLIN, 0}};
        poll(waiting, 2, until_turn(carrier, turn));
        eventfd_t ignored;
        if (waiting[1].revents) eventfd_read(carrier->wake, &ignored);
        if (waiting[0].revents) timers_serve(carrier->routing.env.timers, boottime_ns());
        if (atomic_load(&carrier->notify) >= 0 && monotonic_ns() >= turn) {
            feed_watchdog(carrier);
            turn = monotonic_ns() + atomic_load(&carrier->interval);
        }
    }
    return NULL;
}

/* ---- public ---- */

struct carrier *carrier_open(struct timers *timers, counter *counters, struct ring *events, struct ring *published) {
    struct carrier *carrier = calloc(1, sizeof *carrier);
    if (!carrier) return NULL;
    bool is_open = env_open(&carrier->routing.env, counters, events, timers);
    carrier->routing.published = published;
    timers->heard = counters;
    carrier->notify = -1;
    carrier->epoll = epoll_create1(EPOLL_CLOEXEC);
    carrier->wake = eventfd(0, EFD_CLOEXEC);
    if (!is_open || carrier->epoll < 0 || carrier->wake < 0) {
        carrier_close(carrier);
        return NULL;
    }
    return carrier;
}

int carrier_start(struct carrier *carrier, const struct change *first) {
    carrier_pulse(carrier);
    adopt(carrier, first);
    int error = thread_start(&carrier->timing, "timers", timer_thread, carrier);
    if (error) return error;
    error = thread_start(&carrier->receiving, "receive", receive_thread, carrier);
    carrier->has_started = true;
    carrier->has_stopped = error != 0;
    return error;
}

void carrier_change(struct carrier *carrier, const struct change *change) {
    atomic_store(&carrier->adopted, NULL);
    atomic_store(&carrier->next, change);
    while (atomic_load(&carrier->adopted) != change) usleep(200);
}

void carrier_mirror(struct carrier *carrier, struct ring *mirror, uint32_t lost) {
    atomic_store_explicit(&carrier->mirror_lost, lost, memory_order_relaxed);
    atomic_store_explicit(&carrier->mirror, mirror, memory_order_release);
}

void carrier_pulse(struct carrier *carrier) { atomic_store(&carrier->pulse, monotonic_ns()); }

uint64_t carrier_turns(struct carrier *carrier) { return atomic_load_explicit(&carrier->turns, memory_order_acquire); }

void carrier_watchdog(struct carrier *carrier, int notify, int64_t interval) {
    atomic_store(&carrier->interval, interval);
    atomic_store(&carrier->notify, notify);
    eventfd_write(carrier->wake, 1);
}

bool carrier_counters(struct carrier *carrier, int64_t *to, uint32_t count) {
    return counters_copy(&carrier->edition, carrier->routing.env.counters, to, count);
}

void carrier_stop_receiving(struct carrier *carrier) {
    if (!carrier->has_started || carrier->has_stopped) return;
    atomic_store(&carrier->is_stopping, true);
    pthread_join(carrier->receiving, NULL);
    carrier->has_stopped = true;
}

void carrier_close(struct carrier *carrier) {
    carrier_stop_receiving(carrier);
    if (carrier->has_started) {
        atomic_store(&carrier->is_closing, true);
        eventfd_write(carrier->wake, 1);
        pthread_join(carrier->timing, NULL);
    }
    if (carrier->epoll >= 0) close(carrier->epoll);
    if (carrier->wake >= 0) close(carrier->wake);
    env_close(&carrier->routing.env);
    free(carrier);
}
