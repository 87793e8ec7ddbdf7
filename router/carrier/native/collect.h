/* `collect`: makes frames of datagrams that arrive one by one in any order. A collector keeps their payloads until all of a
 * frame are there; then the topics of the route get the frame as one message.
 *
 * A frame ends its `timeout` after its first datagram; when there is no room, the oldest one does; and when a datagram says
 * that the frame has another size, which opens a new one. What was incomplete then is dropped. The first datagram stands
 * for the whole frame in the counters, the others are counted as collected. Copies are filtered, as are for another
 * `timeout` datagrams of a frame that has ended: they are copies, or of a frame that was counted as lost. */
#ifndef COLLECT_H
#define COLLECT_H

#include <stdbool.h>
#include <stdint.h>

#include "deliver.h"

/* Limits of what a collector holds: open frames, datagrams in them and bytes of their payloads, names of frames that have
 * ended, bytes of a name that is text. */
enum { MOST_FRAMES = 64, MOST_PARTS = 8192, MOST_PART_BYTES = 1 << 24, MOST_CLOSED = 1024, LONGEST_NAME = 255 };

struct collector;

/* How the datagrams of a route make frames. */
struct collect {
    struct collector *collector;
    struct routine by, count, order; /* the name of a frame, its number of datagrams, and the place of this one, from 0 */
    const uint32_t *senders;      /* ids of senders, by column: each has frames of its own */
    uint32_t is_text;             /* `by` is */
    uint32_t signs;               /* enum sign: whether `count` (FIRST) and `order` (SECOND) are unsigned */
    uint16_t items, counted;      /* slots of the list of payloads and of their number, or NONE */
    uint32_t reserved;
};

/* Open a collector, and close one that is in no group of timers any more. One thread uses it, after `timers_change` has
 * said which targets its frames are for; losses are counted by the stage of the group. NULL for lack of memory. */
struct collector *collector_open(int64_t timeout);
void collector_close(struct collector *collector);

/* Keep a datagram for targets with `collect`. Return whether it completes its frame: then the message stands for that, and
 * is to be delivered. Otherwise it has been counted, or will be when its frame ends. */
bool collect(struct stage *stage, const struct targets *to, struct message *message);

#endif
