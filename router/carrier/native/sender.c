#include "sender.h"

#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

#include "clock.h"

static const int64_t RECONNECT_INTERVAL = 100000000; /* ns */

struct sender *sender_open(int fd, uint32_t address, uint16_t port) {
    struct sender *sender = calloc(1, sizeof *sender);
    if (!sender) return NULL;
    sender->fd = fd;
    sender->address = (struct sockaddr_in){
        .sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(address)};
    sender->reconnected_at = -RECONNECT_INTERVAL;
    return sender;
}

void sender_end(struct sender *sender) { atomic_store(&sender->fd, -1); }

void sender_close(struct sender *sender) { free(sender); }

/* Whether there was no network when the socket was connected, there is none now, or this computer has lost the address
 * that the socket sends from. */
static bool has_network_changed(int error) {
    return error == EDESTADDRREQ || error == ENETUNREACH || error == EHOSTUNREACH || error == EINVAL;
}

/* Whether the socket may be replaced now; if so, the caller has to. */
static bool may_reconnect(struct sender *sender) {
    int64_t now = boottime_ns(), last = atomic_load(&sender->reconnected_at);
    if (now - last < RECONNECT_INTERVAL) return false;
    return atomic_compare_exchange_strong(&sender->reconnected_at, &last, now);
}

/* Replace the socket by a new one: `connect` alone would keep its local address, which may have gone. Return 0 or an
 * errno. */
static int reconnect(struct sender *sender) {
    int fresh = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fresh < 0) return errno;
    int error = 0;
    if (connect(fresh, (const struct sockaddr *)&sender->address, sizeof sender->address) ||
        dup3(fresh, sender->fd, O_CLOEXEC) < 0)
        error = errno;
    close(fresh);
    return error;
}

/* Return 0 or an errno. */
static int send_once(struct sender *sender, const void *data, size_t size) {
    return send(atomic_load_explicit(&sender->fd, memory_order_relaxed), data, size, MSG_DONTWAIT) < 0 ? errno : 0;
}

int sender_send(struct sender *sender, const void *data, size_t size) {
    int error = send_once(sender, data, size);
    if (!error) return 0;
    if (error == ECONNREFUSED) {
        int again = send_once(sender, data, size);
        return again ? again : error;
    }
    if (!has_network_changed(error) || !may_reconnect(sender)) return error;
    error = reconnect(sender);
    return error ? error : send_once(sender, data, size);
}

int sender_send_checked(struct sender *sender, const void *data, size_t size) {
    int error = sender_send(sender, data, size);
    if (error) return error;
    socklen_t length = sizeof error;
    return getsockopt(sender->fd, SOL_SOCKET, SO_ERROR, &error, &length) ? errno : error;
}
