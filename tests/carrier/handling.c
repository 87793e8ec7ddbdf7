/* The receive thread and the one that publishes, without threads and sockets: tests give them datagrams, and take what
 * is published. It is compiled with clocked.h. */
#include "publishing.c"
#include "receive.c"
#include "seams.c"

int64_t seam_boottime, seam_wall;

void seam_handle(struct carrier *carrier, uint32_t listener, const void *data, size_t size, uint32_t address, uint32_t port,
                 int64_t arrived_at);

/* `size` is at most MAX_DATAGRAM + 1. What an earlier datagram left behind this one must not count. */
void seam_handle(struct carrier *carrier, uint32_t listener, const void *data, size_t size, uint32_t address, uint32_t port,
                 int64_t arrived_at) {
    struct received received = {.listener = &carrier->program->listeners[listener], .length = size, .address = address,
                                .port = port};
    memset(carrier->datagram, 0xa5, sizeof carrier->datagram);
    if (size) memcpy(carrier->datagram, data, size);
    handle(carrier, &received, arrived_at);
}

/* The thread that publishes, as it is between two messages. */
struct publishing *seam_publishing_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish);
void seam_publish(struct publishing *publishing);
void seam_publishing_close(struct publishing *publishing);

struct publishing *seam_publishing_open(struct ring *ring, counter *counters, struct ring *events, publish_function *publish) {
    struct publishing *made = calloc(1, sizeof *made);
    *made = (struct publishing){.ring = ring, .counters = counters, .reporter.events = events, .publish = publish};
    pthread_mutex_init(&made->lock, NULL);
    composer_open(&made->composer);
    return made;
}

/* Serve all that waits. */
void seam_publish(struct publishing *publishing) {
    pthread_mutex_lock(&publishing->lock);
    for (size_t size; (size = take(publishing, false));) serve_all(publishing, size);
    pthread_mutex_unlock(&publishing->lock);
}

void seam_publishing_close(struct publishing *publishing) {
    composer_close(&publishing->composer);
    free(publishing);
}
