/* TCP connections that frames are sent through. */
#ifndef TCP_H
#define TCP_H

#include <stdbool.h>
#include <stdint.h>

/* Connect to an address (host byte order), for at most a second, or until `wake` is readable. Return a descriptor that does not
 * block, or a negative errno. */
int tcp_connect(uint32_t host, uint32_t port, uint32_t patience, int wake);

/* Listen at an address. Return a descriptor that does not block, or a negative errno: ENONET if the network interface of a
 * link-local address is missing. */
int tcp_listen(uint32_t host, uint32_t port);

/* Whether a socket that listens at an address is bound to its present network interface. One that was removed and has come
 * back is another one. */
bool tcp_is_at(int fd, uint32_t host);

/* Send each frame at once, and look after a second of silence whether the other end is still there. Also while this process
 * does not run, the kernel ends the connection if sent bytes are not acknowledged, `patience` (ms) after it has sent them again,
 * which is 200 ms too late for short deadmen. */
void tcp_settle(int fd, uint32_t patience);

/* Since when sent bytes have waited for an acknowledgement. */
struct tcp_watch {
    uint64_t acknowledged; /* bytes */
    int64_t since;         /* monotonic */
};

/* Return how long (ns) nothing was acknowledged although bytes wait for that, as often as this is called. */
int64_t tcp_unacknowledged(int fd, struct tcp_watch *watch, int64_t now);

/* The number of bytes that the kernel cannot send yet: what is under way is not counted. */
int tcp_waiting(int fd);

/* Close a connection, and discard what has not arrived at the other end. */
void tcp_abort(int fd);

#endif
