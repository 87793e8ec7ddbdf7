/* A non-blocking UDP socket, connected to one destination. Any thread may send. */
#ifndef SENDER_H
#define SENDER_H

#include <netinet/in.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct sender {
    _Atomic int fd; /* stays the same when the socket is replaced; -1 after `sender_end` */
    struct sockaddr_in address;
    _Atomic int64_t reconnected_at; /* boot clock, ns */
};

/* Return a sender for a socket that is connected to `address` (host byte order) and `port`, or NULL for lack of memory.
 * The caller closes the socket, after `sender_end`: sending fails with EBADF from then on. */
struct sender *sender_open(int fd, uint32_t address, uint16_t port);
void sender_end(struct sender *sender);
void sender_close(struct sender *sender); /* when nothing refers to it any more */

/* Send a datagram. Return 0, or an errno: then exactly one datagram is lost.
 *
 * ECONNREFUSED is about an earlier datagram, which was counted as sent. The kernel returns it instead of sending this
 * one; so this one is sent again, and the error returned for the earlier one: the counters balance. If the network has
 * changed, the socket is replaced and connected again first, at most once per 100 ms. */
int sender_send(struct sender *sender, const void *data, size_t size);

/* As `sender_send`, but also return errors of this datagram that are known at once: no process listens on a local port.
 * With `sender_send`, the next datagram would get that error. */
int sender_send_checked(struct sender *sender, const void *data, size_t size);

#endif
