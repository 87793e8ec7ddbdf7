/* `collect`: assembles frames from datagrams that arrive in any order. A collector keeps payloads until a frame is complete;
 * then the topics of the route get the frame as one message.
 *
 * An incomplete frame is dropped `timeout` after its first datagram, when it is the oldest and there is no room, or when a
 * datagram gives another size for it, which opens a new frame. The counters count a frame as its first datagram, and its
 * other datagrams as collected. Duplicates are filtered. So are, for another `timeout`, datagrams of a frame that has
 * ended: they are duplicates, or their frame was counted as lost. */
#ifndef COLLECT_H
#define COLLECT_H

#include <stdbool.h>
#include <stdint.h>

#include "deliver.h"

/* Limits of a collector: open frames, their datagrams and bytes of payload, remembered names of ended frames, bytes of a
 * text name. */
enum { MOST_FRAMES = 64, MOST_PARTS = 8192, MOST_PART_BYTES = 1 << 24, MOST_CLOSED = 1024, LONGEST_NAME = 255 };

struct collector;

/* How a route assembles frames. */
struct collect {
    struct collector *collector;
    struct routine by, count, order; /* the name of the frame, its number of datagrams, and the position of this one, from 0 */
    const uint32_t *senders;      /* ids of senders by column; each sender has its own frames */
    uint32_t is_text;             /* whether `by` is text */
    uint32_t signs;               /* enum sign: whether `count` (FIRST) and `order` (SECOND) are unsigned */
    uint16_t items, counted;      /* slots of the list of payloads and of their number, or NONE */
    uint32_t reserved;
};

/* Open a collector; close one that is in no group of timers. One thread uses it, after `timers_change` has set the targets
 * of its frames. The environment of the group counts losses. Returns NULL if memory runs out. */
struct collector *collector_open(int64_t timeout);
void collector_close(struct collector *collector);

/* Keep a datagram for targets with `collect`. Return whether it completes its frame: then `message` is the frame, and the
 * caller delivers it. Otherwise the datagram is counted, now or when its frame ends. */
bool collect(struct thread_env *env, const struct targets *to, struct message *message);

#endif
