/* A non-blocking UDP socket for one destination. Any thread may send.
 *
 * It is not connected, so that what comes back reaches a listener. It is bound to the address and port of one, or to a
 * port that the kernel has chosen. ICMP errors about what it has sent reach the listener; without one, or if they come by
 * another interface than the listener's, the socket itself. */
#ifndef SENDER_H
#define SENDER_H

#include <netinet/in.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct sender {
    struct sender *next; /* in the list of all */
    struct sockaddr_in address;
    _Atomic int fd;       /* -1 after `sender_end` */
    _Atomic int listener; /* the socket of the listener from whose port it sends; -1 for none */
    _Atomic int refused;  /* errno of an earlier datagram, not returned yet; 0 for none */
};

/* Return a sender to `address` (host byte order) and `port`, or NULL for lack of memory. The caller closes the sockets,
 * after `sender_end`: sending fails with EBADF from then on. */
struct sender *sender_open(int fd, int listener, uint32_t address, uint16_t port);
void sender_end(struct sender *sender);
void sender_close(struct sender *sender); /* when nothing refers to it any more */

/* Send by another socket from now on. The caller closes the earlier one when no thread uses it any more. */
void sender_move(struct sender *sender, int fd, int listener);

/* Send a datagram. Return 0, or an errno: then exactly one datagram is lost.
 *
 * An error may be about an earlier datagram, which was counted as sent and which its receiver has refused: nobody listens
 * there (ECONNREFUSED), or its firewall says no. Then this datagram was sent, so the counters balance. */
int sender_send(struct sender *sender, const void *data, size_t size);

/* The two steps of `sender_send`: send the datagram and return an errno of its own, then return that of an earlier one. */
int sender_send_only(struct sender *sender, const void *data, size_t size);
int sender_take_refused(struct sender *sender);

/* As `sender_send`, for deadmen. A send buffer that commands have filled does not stop the datagram. Errors of this datagram
 * that are known at once are returned as well: no process listens on a local port. With `sender_send`, a later datagram
 * would get that error. One thread at a time may send so. */
int sender_send_checked(struct sender *sender, const void *data, size_t size);

/* Read the ICMP errors that a listener has, for the senders whose datagrams they are about. Return whether there
 * were any. A flood of them is cut short. */
bool sender_note_errors(int listener);

#endif
