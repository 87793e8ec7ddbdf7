/* `order`: datagrams of a route pass only if their number is higher than that of the last one from the same sender, so
 * neither duplicates nor what was overtaken on the way are delivered.
 *
 * A sender is an address and a port. It begins again with any number once nothing of it has passed for some time, because it
 * may have restarted. */
#ifndef ORDER_H
#define ORDER_H

#include <stdbool.h>
#include <stdint.h>

#include "operations.h"

enum { MOST_SENDERS = 64 /* of a route; beyond, the one of which nothing has passed for the longest time is forgotten */ };

struct order_state;

struct ordering {
    struct order_state *state;
    struct routine number;
    const struct layout *layout;  /* the fields that it reads */
    const struct value *sources;  /* names of senders, by column */
    const int64_t *patience;      /* ns without a newer number after which any number passes, by column */
    uint32_t bits;                /* the number wraps around like an integer of that many bits */
    uint32_t is_unsigned;
};

/* Open the state of a route. One thread uses it. Returns NULL if memory runs out. */
struct order_state *order_state_open(void);
void order_state_close(struct order_state *state);

/* Return whether the number of a datagram, which was received at `now` (boot clock, ns), passes; otherwise `last` is set to
 * the highest one of its sender. */
bool order_passes(struct order_state *state, uint32_t address, uint32_t port, uint64_t number, uint32_t bits,
                  int64_t patience, int64_t now, uint64_t *last);

#endif
