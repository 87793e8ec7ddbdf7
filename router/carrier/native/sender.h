/* A non-blocking UDP socket for one destination, or a link (link.h). Any thread may send.
 *
 * It is not connected, so that replies reach a listener. It is bound to the address and port of that listener, or to a port
 * chosen by the kernel. ICMP errors about its datagrams reach the listener, or the socket itself if there is no listener or
 * they arrive on another interface than the listener's; for IPv6, the latter are lost. */
#ifndef SENDER_H
#define SENDER_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct link;

struct sender {
    struct sender *next; /* in the list of all senders */
    struct link *link;   /* NULL for a socket. A link has no address, so sending to that fails first */
    _Atomic uint64_t to;  /* its address and port; 0 while it has no address */
    _Atomic int fd;       /* -1 after `sender_end` */
    _Atomic int listener; /* the socket of the listener from whose port it sends; -1 for none */
    _Atomic int refused;  /* errno about an earlier datagram, not returned yet; 0 for none */
};

/* Open a sender to `address` (hosts.h) and `port`; to 0 and 0 while it has no address, and sending fails with
 * EDESTADDRREQ. Returns NULL if memory runs out. The caller closes the sockets after `sender_end`, after which sending fails
 * with EBADF. */
struct sender *sender_open(int fd, int listener, uint32_t address, uint16_t port);
void sender_end(struct sender *sender);
void sender_close(struct sender *sender); /* when nothing uses it */

/* Make the sender of a link, which is not in the list and not closed. */
void sender_on_link(struct sender *sender, struct link *link);

/* Send to another address from now on, or to none. Errors about the earlier one are forgotten. */
void sender_aim(struct sender *sender, uint32_t address, uint16_t port);
static inline bool sender_has_address(const struct sender *sender) {
    return atomic_load_explicit(&sender->to, memory_order_relaxed) != 0;
}

/* Send through another socket from now on. The caller closes the earlier one when no thread uses it. */
void sender_move(struct sender *sender, int fd, int listener);

/* Send a datagram. Return 0, or an errno: then exactly one datagram is lost.
 *
 * An error may be about an earlier datagram, which was counted as sent and then refused: no process listens there
 * (ECONNREFUSED), or a firewall rejects it. Then this datagram was sent, so the counters balance. */
int sender_send(struct sender *sender, const void *data, size_t size);

/* The two steps of `sender_send`: send the datagram and return its own errno; return the errno of an earlier one. */
int sender_send_only(struct sender *sender, const void *data, size_t size);
int sender_take_refused(struct sender *sender);

/* Like `sender_send`, for deadmen. It sends even if commands have filled the send buffer. It also returns immediate errors
 * of this datagram: no process listens on a local port. `sender_send` would return these for a later datagram. Only one
 * thread at a time may call it. */
int sender_send_checked(struct sender *sender, const void *data, size_t size);

/* Read the ICMP errors of a listener, and assign them to the senders of the datagrams. Return whether there were any. Stops
 * early in a flood. */
bool sender_note_errors(int listener);

#endif
