/* A queue of records from one thread to another that drops its oldest record when it is full.
 *
 * The writing thread never waits: it drops the oldest record when it needs the room. The reader copies records and then
 * claims them; a claim fails if the record was dropped meanwhile, and the copy is discarded.
 * Records are multiples of 8 bytes, and start with their size as a uint32_t. */
#ifndef RING_H
#define RING_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct ring {
    _Atomic uint64_t written; /* bytes, since the ring was opened */
    _Atomic uint64_t taken;   /* bytes taken or dropped */
    _Atomic uint32_t is_waited_for; /* futex: 1 while a reader sleeps */
    _Atomic bool is_woken, is_watched;
    int wake; /* eventfd, for a reader that watches */
    size_t capacity;
    _Atomic uint64_t *words;
};

/* The size in the ring of a record of `size` bytes. */
static inline uint32_t padded_to_word(size_t size) { return (uint32_t)((size + 7) & ~(size_t)7); }

/* Open a ring for `capacity` bytes, a power of two. Returns NULL if memory or descriptors run out. */
struct ring *ring_open(size_t capacity);
void ring_close(struct ring *ring);

/* For the writer. `ring_put` returns false if there is no room; `ring_drop` copies up to `limit` bytes of the oldest record
 * to `record`, drops it and returns true, or returns false if the reader was faster. */
bool ring_put(struct ring *ring, const void *record, uint32_t size);
/* Likewise, without waking the reader before half of the ring is used. */
bool ring_put_quietly(struct ring *ring, const void *record, uint32_t size);
bool ring_drop(struct ring *ring, void *record, size_t limit);

/* For the reader. Copy as many whole records as fit and return their size in bytes. If there are none, wait for up to
 * `timeout` ns (-1: forever), and return 0 after that, after `ring_wake`, or spuriously. A record longer than `limit` is
 * never taken: the buffer must be as long as the longest record. */
bool ring_is_empty(const struct ring *ring);
size_t ring_take(struct ring *ring, void *records, size_t limit, int64_t timeout);
void ring_wake(struct ring *ring);

/* Return an eventfd that each record makes readable from now on: for a reader that waits for several rings, and takes with a
 * timeout of 0. */
int ring_watch(struct ring *ring);

#endif
