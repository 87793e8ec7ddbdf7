/* Links: byte streams to a board, such as a serial line, which carry frames (framing.h) instead of datagrams.
 *
 * A link has a thread, which opens it, and opens it again each second after it has ended. When it has opened, the deadmen that
 * send to its other end send first. Everything that can block is done by this thread.
 *
 * The receive thread reads: `ready` is an epoll descriptor that stays the same while the link is closed and opened. Any
 * thread sends, through `sender`, as to a UDP destination, and never waits: what does not fit is lost with EAGAIN. At most
 * 10 ms of the line's time wait in the kernel, so that a brake is not sent behind old commands. A brake that does not fit
 * waits in `rest`, behind a frame that is half written, and goes before everything else. */
#ifndef LINK_H
#define LINK_H

#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>

#include "envelope.h"
#include "framing.h"
#include "sender.h"
#include "serial.h"
#include "timers.h"

struct link;

/* Open a link to a serial device. `listener` identifies it in events; `up` and `openings` are counters of the group. `framing`
 * is copied. The first member is a struct sender. Returns NULL if memory, descriptors or threads run out. */
struct link *link_open(struct timers *timers, const char *path, uint32_t baud, uint32_t parity, uint32_t stop_bits,
                       uint32_t framing, uint32_t checksum, bool is_big_endian, uint32_t address, uint32_t listener,
                       uint32_t up, uint32_t openings);

/* Close the device, and end the thread. Bytes that were sent get 100 ms to leave. Senders get ENOTCONN. May be called again. */
void link_stop(struct link *link);

/* Stop it and free it, once no thread uses it. */
void link_close(struct link *link);

/* ---- for senders ---- */

/* Send a frame; a brake goes before everything that waits. Return 0, EAGAIN if there is no room, or why the link is closed. */
int link_send(struct link *link, const void *data, size_t size, bool is_brake);

/* ---- for the receive thread ---- */

/* A descriptor for epoll: readable when the link has bytes to read, or room for bytes that wait. */
int link_ready(const struct link *link);

/* Read the bytes that have arrived, up to a fixed number, and write bytes that wait. */
void link_serve(struct link *link);

/* Return the next frame of the bytes that were read. Then `to`, with room for MAX_DATAGRAM bytes, has the payload, `length` is set,
 * and `began` to the time (boot clock, ns) when the first byte of the frame was read. */
enum framed link_next(struct link *link, uint8_t *to, size_t *length, int64_t *began);

#endif
