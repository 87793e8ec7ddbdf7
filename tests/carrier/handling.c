/* The receive thread and the one that publishes, without threads and sockets: tests give them datagrams, and take what
 * is published. It is compiled with clocked.h. */
#include "publish.c"
#include "receive.c"
#include "seams.c"

int64_t seam_boottime, seam_wall;

void seam_handle(struct carrier *carrier, uint32_t listener, const void *data, size_t size, uint32_t address, uint32_t port,
                 int64_t arrived_at);

/* `size` is at most MAX_DATAGRAM + 1. What an earlier datagram left behind this one must not count. */
void seam_handle(struct carrier *carrier, uint32_t listener, const void *data, size_t size, uint32_t address, uint32_t port,
                 int64_t arrived_at) {
    struct received received = {.listener = &carrier->routing.program->listeners[listener], .length = size,
                                .address = address, .port = port, .arrived_at = arrived_at};
    memset(carrier->routing.datagram, 0xa5, sizeof carrier->routing.datagram);
    if (size) memcpy(carrier->routing.datagram, data, size);
    handle(carrier, &received);
}

/* The thread that publishes, as it is between two messages. */
struct publish_thread *seam_publish_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish);
void seam_publish(struct publish_thread *thread);
struct timers *seam_publish_timers(struct publish_thread *thread);
void seam_publish_close(struct publish_thread *thread);

struct publish_thread *seam_publish_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish) {
    return publish_prepare(ring, counters, events, publish, NULL, NULL);
}

/* Serve all that waits. */
void seam_publish(struct publish_thread *thread) {
    pthread_mutex_lock(&thread->lock);
    for (size_t size; (size = take(thread, false));) serve_all(thread, size);
    pthread_mutex_unlock(&thread->lock);
}

struct timers *seam_publish_timers(struct publish_thread *thread) { return thread->stage.timers; }

void seam_publish_close(struct publish_thread *thread) { publish_close(thread); }
