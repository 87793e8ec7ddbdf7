/* Links: byte streams to a board, a serial line or a TCP connection, which carry frames (framing.h) instead of datagrams.
 *
 * A link has a thread, which opens it, and opens it again each second after it has ended. When it has opened, the deadmen that
 * send to its other end send first. Everything that can block is done by this thread.
 *
 * The receive thread reads: `ready` is an epoll descriptor that stays the same while the link is closed and opened. Any
 * thread sends, through `sender`, as to a UDP destination, and never waits: what does not fit is lost with EAGAIN. At most
 * 10 ms of a line's time, or 4 KiB over TCP, wait in the kernel, so that a brake is not sent behind old commands. A brake that
 * does not fit waits in `rest`, behind a frame that is half written, and goes before everything else. */
#ifndef LINK_H
#define LINK_H

#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>

#include "envelope.h"
#include "framing.h"
#include "sender.h"
#include "serial.h"
#include "server.h"
#include "timers.h"

struct link;

enum medium {
    MEDIUM_SERIAL,
    MEDIUM_CLIENT, /* TCP: the link connects */
    MEDIUM_SERVER  /* TCP: the other end connects to a server */
};

struct link_settings {
    struct framing framing;
    struct serial line;    /* of MEDIUM_SERIAL */
    uint32_t medium;       /* enum medium */
    uint32_t host, port;   /* of the other end of MEDIUM_CLIENT and MEDIUM_SERVER, which has port 0; host byte order */
    uint32_t patience;     /* ms: how long bytes may be unacknowledged before the connection ends */
    uint32_t endpoint;     /* in events */
    uint32_t up, openings; /* counters of the group */
    uint32_t reserved;
};

/* Open a link. `settings` are copied. `path` is the device of a serial line, otherwise empty, `server` that of MEDIUM_SERVER,
 * otherwise NULL. The first member is a struct sender. Returns NULL if memory, descriptors or threads run out. */
struct link *link_open(struct timers *timers, const struct link_settings *settings, const char *path, struct server *server);

/* Close the stream, and end the thread. Bytes that were sent get 100 ms to leave. Senders get ENOTCONN. May be called again. */
void link_stop(struct link *link);

/* Stop it and free it, once no thread uses it. */
void link_close(struct link *link);

/* ---- for its server ---- */

/* Use an accepted connection in place of an earlier one, which its other end has given up. */
void link_offer(struct link *link, int fd);

/* Report why the link cannot be opened (errno), unless that is known. */
void link_fail(struct link *link, int why);

/* ---- for senders ---- */

/* Send a frame; a brake goes before everything that waits. Return 0, EAGAIN if there is no room, or why the link is closed. */
int link_send(struct link *link, const void *data, size_t size, bool is_brake);

/* ---- for the receive thread ---- */

/* A descriptor for epoll: readable when the link has bytes to read, or room for bytes that wait. */
int link_ready(const struct link *link);

/* The IP address of the other end (host byte order); 0 for a serial line. */
uint32_t link_host(const struct link *link);

/* Read the bytes that have arrived, up to a fixed number, and write bytes that wait. */
void link_serve(struct link *link);

/* Return the next frame of the bytes that were read. Then `to`, with room for MAX_DATAGRAM bytes, has the payload, `length` is set,
 * and `began` to the time (boot clock, ns) when the first byte of the frame was read. */
enum framed link_next(struct link *link, uint8_t *to, size_t *length, int64_t *began);

#endif
