/* The receive thread without its thread and without sockets: tests give it datagrams. It is compiled with clocked.h. */
#include "receive.c"
#include "seams.c"

int64_t seam_monotonic, seam_wall;

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
