#include "link.h"

#include <errno.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "clock.h"
#include "deadman.h"
#include "deliver.h"
#include "events.h"
#include "priority.h"
#include "tcp.h"
#include "threads.h"

enum {
    AGAIN_MS = 1000,       /* from one attempt to open it to the next */
    NS_PER_MS = 1000000,
    LOOKS_PER_PATIENCE = 8,
    BITS_PER_BYTE = 10,
    ROOM_MS = 10,          /* of a line's time: what may wait in the kernel */
    TCP_ROOM = 4096,       /* bytes: likewise, for small frames behind one that the network interface is sending */
    LAST_MS = 100,         /* for the last bytes to leave */
    READ_AT_ONCE = 1024,   /* bytes: less than the kernel holds, so that a link delays other listeners only briefly */
    BRAKES_WAITING = 4096, /* bytes, beside a half-written frame */
};

enum state { CLOSED, BRAKING /* only brakes are sent */, OPEN, ENDED /* to be closed by its thread */ };

struct link {
    struct sender sender; /* first: its address is that of the link */
    struct timers *timers;
    struct link_settings of;
    struct server *server; /* NULL if it connects itself */
    struct client client;  /* at the server */
    uint32_t room;         /* bytes */
    int ready;             /* epoll */
    int wake;              /* eventfd: for its thread */
    pthread_t thread;
    _Atomic bool is_stopping;
    int reported; /* errno: why it is closed, as last reported. With the lock of the group */

    pthread_mutex_t lock; /* for the rest up to `rest`; held only briefly */
    enum state state;
    int fd;
    int offered;      /* an accepted connection; -1 for none */
    int why;          /* errno: why it is closed */
    bool has_begun;   /* a new stream, of which nothing was read */
    size_t rest_size; /* bytes that wait: of a half-written frame, then brakes */
    uint8_t frame[LONGEST_FRAME];
    uint8_t rest[LONGEST_FRAME + BRAKES_WAITING];

    /* Of the receive thread: */
    struct deframer deframer;
    const uint8_t *next, *end; /* of `input` */
    int64_t began, read_at;    /* boot clock: when the first byte of the partial frame was read, and of `input` */
    uint8_t input[READ_AT_ONCE];

    char path[];
};

/* ---- with the lock held ---- */

static void await(struct link *link, uint32_t events, int change) {
    struct epoll_event interest = {.events = events};
    epoll_ctl(link->ready, change, link->fd, &interest);
}

/* The stream has ended: have its thread close and open it. */
static void end(struct link *link, int why) {
    if (link->state != OPEN && link->state != BRAKING) return;
    link->state = ENDED;
    link->why = why;
    link->rest_size = 0;
    await(link, 0, EPOLL_CTL_DEL);
    eventfd_write(link->wake, 1);
}

/* Write as much as fits. Return the number of bytes; 0 also if the stream has ended. */
static size_t put(struct link *link, const uint8_t *bytes, size_t size) {
    ssize_t written = write(link->fd, bytes, size); /* Python ignores SIGPIPE */
    if (written >= 0) return (size_t)written;
    if (errno != EAGAIN && errno != EINTR) end(link, errno);
    return 0;
}

static void put_rest(struct link *link) {
    if (!link->rest_size) return;
    size_t written = put(link, link->rest, link->rest_size);
    if (!link->rest_size) return; /* it has ended */
    link->rest_size -= written;
    memmove(link->rest, link->rest + written, link->rest_size);
    if (!link->rest_size) await(link, EPOLLIN, EPOLL_CTL_MOD);
}

static bool keep(struct link *link, const uint8_t *bytes, size_t size) {
    if (size > sizeof link->rest - link->rest_size) return false;
    if (!link->rest_size) await(link, EPOLLIN | EPOLLOUT, EPOLL_CTL_MOD);
    memcpy(link->rest + link->rest_size, bytes, size);
    link->rest_size += size;
    return true;
}

static bool takes_more(const struct link *link) {
    int waiting = link->of.medium == MEDIUM_SERIAL ? serial_waiting(link->fd) : tcp_waiting(link->fd);
    return !link->rest_size && (uint32_t)waiting <= link->room;
}

static bool is_open(const struct link *link, bool is_brake) {
    return link->state == OPEN || (is_brake && link->state == BRAKING);
}

static int send_frame(struct link *link, const void *data, size_t size, bool is_brake) {
    put_rest(link);
    if (!is_open(link, is_brake)) return link->why;
    if (!is_brake && !takes_more(link)) return EAGAIN;
    size_t length = frame_write(&link->of.framing, data, size, link->frame);
    if (!length) return EMSGSIZE;
    size_t written = link->rest_size ? 0 : put(link, link->frame, length);
    if (!is_open(link, is_brake)) return link->why;
    if (written == length) return 0;
    if (!written && !is_brake) return EAGAIN;
    return keep(link, link->frame + written, length - written) ? 0 : EAGAIN;
}

/* ---- its thread ---- */

/* Report, with the lock of the group held, that the link is open, or why it is closed. */
static void report_change(struct link *link, int why) {
    struct link_event event = {.kind = EVENT_LINK, .endpoint = link->of.endpoint, .error = why};
    struct ring *events = link->timers->env->reporter.events;
    if (events) put_event(events, &event, sizeof event, "");
    link->reported = why;
}

/* Let everything through, brakes first. The delimiter ends a frame that had begun when the link was closed. */
static void connect_to(struct link *link, int fd) {
    int delimiter = framing_delimiter(&link->of.framing);
    pthread_mutex_lock(&link->timers->lock); /* commands with a deadman wait for it */
    pthread_mutex_lock(&link->lock);
    link->fd = fd;
    link->state = BRAKING;
    link->has_begun = true;
    await(link, EPOLLIN, EPOLL_CTL_ADD);
    if (delimiter >= 0) put(link, &(uint8_t){(uint8_t)delimiter}, 1);
    pthread_mutex_unlock(&link->lock);
    deadmen_send_first(link->timers, &link->sender);
    counter_set(link->timers->env->counters, link->of.up, 1);
    env_count(link->timers->env, link->of.openings, 1);
    report_change(link, 0);
    pthread_mutex_lock(&link->lock);
    if (link->state == BRAKING) link->state = OPEN;
    pthread_mutex_unlock(&link->lock);
    pthread_mutex_unlock(&link->timers->lock);
}

static void disconnect(struct link *link) {
    pthread_mutex_lock(&link->lock);
    end(link, ENOTCONN);
    int fd = link->fd, why = link->why;
    link->fd = -1;
    link->state = CLOSED;
    pthread_mutex_unlock(&link->lock);
    if (link->of.medium == MEDIUM_SERIAL) serial_close(fd);
    else if (atomic_load(&link->is_stopping)) close(fd);
    else tcp_abort(fd);
    pthread_mutex_lock(&link->timers->lock);
    counter_set(link->timers->env->counters, link->of.up, 0);
    if (!atomic_load(&link->is_stopping)) report_change(link, why);
    pthread_mutex_unlock(&link->timers->lock);
}

void link_fail(struct link *link, int why) {
    pthread_mutex_lock(&link->timers->lock);
    pthread_mutex_lock(&link->lock);
    bool is_closed = link->state == CLOSED;
    if (is_closed) link->why = why;
    pthread_mutex_unlock(&link->lock);
    if (is_closed && why != link->reported) report_change(link, why);
    pthread_mutex_unlock(&link->timers->lock);
}

/* Wait until the stream has ended or the link is to be closed, or for some time (ms; -1: no limit). Return false after that. */
static bool await_wake(struct link *link, int timeout) {
    struct pollfd waiting = {link->wake, POLLIN, 0};
    eventfd_t ignored;
    if (!poll(&waiting, 1, timeout)) return false;
    eventfd_read(link->wake, &ignored);
    return true;
}

/* Wait until the stream has ended or the link is to be closed. End a connection whose other end acknowledges nothing. */
static void await_end(struct link *link) {
    if (link->of.medium == MEDIUM_SERIAL) {
        await_wake(link, -1);
        return;
    }
    struct tcp_watch watch = {0, monotonic_ns()};
    while (!await_wake(link, (int)link->of.patience / LOOKS_PER_PATIENCE + 1)) {
        if (tcp_unacknowledged(link->fd, &watch, monotonic_ns()) < (int64_t)link->of.patience * NS_PER_MS) continue;
        pthread_mutex_lock(&link->lock);
        end(link, ETIMEDOUT);
        pthread_mutex_unlock(&link->lock);
    }
}

static bool has_waiting(struct link *link) {
    pthread_mutex_lock(&link->lock);
    if (is_open(link, true)) put_rest(link);
    bool is_waiting = is_open(link, true) && (link->rest_size || serial_waiting(link->fd));
    pthread_mutex_unlock(&link->lock);
    return is_waiting;
}

static void let_leave(struct link *link) {
    for (int left = LAST_MS; left && has_waiting(link); left--) usleep(1000);
}

static int take_offered(struct link *link) {
    pthread_mutex_lock(&link->lock);
    int fd = link->offered;
    link->offered = -1;
    pthread_mutex_unlock(&link->lock);
    return fd;
}

/* Wait for a connection that the server accepts. Return its descriptor, or a negative errno if the link is to be closed. */
static int await_offer(struct link *link) {
    int fd;
    while ((fd = take_offered(link)) < 0) {
        if (atomic_load(&link->is_stopping)) return -ENOTCONN;
        await_wake(link, -1);
    }
    tcp_settle(fd, link->of.patience);
    return fd;
}

static int open_stream(struct link *link) {
    const struct link_settings *of = &link->of;
    switch (of->medium) {
    case MEDIUM_SERIAL: return serial_open(link->path, &of->line);
    case MEDIUM_CLIENT: return tcp_connect(of->host, of->port, of->patience, link->wake);
    default: return await_offer(link);
    }
}

static void *link_thread(void *of) {
    struct link *link = of;
    run_first();
    if (link->server) link_fail(link, ENOTCONN);
    while (!atomic_load(&link->is_stopping)) {
        int64_t again = monotonic_ns() + AGAIN_MS * NS_PER_MS;
        int fd = open_stream(link);
        if (fd >= 0) {
            connect_to(link, fd);
            await_end(link);
            if (atomic_load(&link->is_stopping)) let_leave(link);
            disconnect(link);
        } else if (!atomic_load(&link->is_stopping)) {
            link_fail(link, -fd);
        }
        int64_t left = (again - monotonic_ns()) / NS_PER_MS;
        if (!atomic_load(&link->is_stopping) && left > 0) await_wake(link, (int)left);
    }
    return NULL;
}

/* ---- public ---- */

static void release(struct link *link) {
    if (link->offered >= 0) tcp_abort(link->offered);
    if (link->ready >= 0) close(link->ready);
    if (link->wake >= 0) close(link->wake);
    pthread_mutex_destroy(&link->lock);
    free(link);
}

struct link *link_open(struct timers *timers, const struct link_settings *settings, const char *path, struct server *server) {
    struct link *link = calloc(1, sizeof *link + strlen(path) + 1);
    if (!link || lock_open(&link->lock)) {
        free(link);
        return NULL;
    }
    strcpy(link->path, path);
    sender_on_link(&link->sender, link);
    link->timers = timers;
    link->of = *settings;
    link->server = server;
    link->client = (struct client){.link = link, .host = settings->host};
    bool is_line = settings->medium == MEDIUM_SERIAL;
    link->room = is_line ? settings->line.baud / BITS_PER_BYTE * ROOM_MS / 1000 : TCP_ROOM;
    link->fd = link->offered = -1;
    link->why = ENOTCONN;
    link->ready = epoll_create1(EPOLL_CLOEXEC);
    link->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (link->ready < 0 || link->wake < 0 || thread_start(&link->thread, "link", link_thread, link)) {
        release(link);
        return NULL;
    }
    if (server) server_join(server, &link->client);
    return link;
}

void link_stop(struct link *link) {
    if (atomic_exchange(&link->is_stopping, true)) return;
    if (link->server) server_leave(link->server, &link->client);
    eventfd_write(link->wake, 1);
    pthread_join(link->thread, NULL);
}

void link_close(struct link *link) {
    link_stop(link);
    release(link);
}

void link_offer(struct link *link, int fd) {
    pthread_mutex_lock(&link->lock);
    int earlier = link->offered;
    link->offered = fd;
    end(link, ECONNABORTED);
    pthread_mutex_unlock(&link->lock);
    if (earlier >= 0) tcp_abort(earlier);
    eventfd_write(link->wake, 1);
}

int link_send(struct link *link, const void *data, size_t size, bool is_brake) {
    pthread_mutex_lock(&link->lock);
    int error = is_open(link, is_brake) ? send_frame(link, data, size, is_brake) : link->why;
    pthread_mutex_unlock(&link->lock);
    return error;
}

int link_ready(const struct link *link) { return link->ready; }

uint32_t link_host(const struct link *link) { return link->of.host; }

void link_serve(struct link *link) {
    link->next = link->end = link->input;
    pthread_mutex_lock(&link->lock);
    if (is_open(link, true)) put_rest(link);
    if (is_open(link, true)) {
        ssize_t size = read(link->fd, link->input, sizeof link->input);
        if (size > 0) link->end = link->input + size;
        else if (!size) end(link, link->of.medium == MEDIUM_SERIAL ? EIO : ECONNRESET);
        else if (errno != EAGAIN && errno != EINTR) end(link, errno);
    }
    bool has_begun = link->has_begun;
    link->has_begun = false;
    pthread_mutex_unlock(&link->lock);
    link->read_at = boottime_ns();
    if (has_begun) deframer_begin(&link->deframer, &link->of.framing);
    if (!deframer_is_within(&link->deframer)) link->began = link->read_at;
}

enum framed link_next(struct link *link, uint8_t *to, size_t *length, int64_t *began) {
    enum framed framed = deframe(&link->deframer, &link->next, link->end);
    *began = link->began;
    if (framed == FRAME_PARTIAL) return framed;
    link->began = link->read_at;
    if (framed == FRAME_READY) {
        memcpy(to, link->deframer.payload, link->deframer.length);
        *length = link->deframer.length;
    } else if (framing_delimiter(&link->of.framing) < 0) {
        pthread_mutex_lock(&link->lock);
        end(link, EPROTO);
        pthread_mutex_unlock(&link->lock);
        link->next = link->end;
    }
    return framed;
}
