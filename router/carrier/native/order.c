#include "order.h"

#include <stdlib.h>

struct sender_order {
    uint32_t address, port;
    uint64_t number;   /* of the last datagram that passed, */
    int64_t passed_at; /* and when that was */
};

struct order_state {
    uint32_t count;
    struct sender_order senders[MOST_SENDERS];
};

/* Whether a number is ahead of another one by less than half of the range, as in RFC 1982. */
static bool is_newer(uint64_t number, uint64_t last, uint32_t bits) { return (int64_t)((number - last) << (64 - bits)) > 0; }

static struct sender_order *find(struct order_state *state, uint32_t address, uint32_t port) {
    for (uint32_t index = 0; index < state->count; index++)
        if (state->senders[index].address == address && state->senders[index].port == port) return &state->senders[index];
    return NULL;
}

static struct sender_order *unused(struct order_state *state) {
    if (state->count < MOST_SENDERS) return &state->senders[state->count++];
    struct sender_order *oldest = state->senders;
    for (uint32_t index = 1; index < MOST_SENDERS; index++)
        if (state->senders[index].passed_at < oldest->passed_at) oldest = &state->senders[index];
    return oldest;
}

bool order_passes(struct order_state *state, uint32_t address, uint32_t port, uint64_t number, uint32_t bits,
                  int64_t patience, int64_t now, uint64_t *last) {
    struct sender_order *found = find(state, address, port);
    if (found && now - found->passed_at <= patience && !is_newer(number, found->number, bits)) {
        *last = found->number;
        return false;
    }
    if (!found) found = unused(state);
    *found = (struct sender_order){address, port, number, now};
    return true;
}

struct order_state *order_state_open(void) { return calloc(1, sizeof(struct order_state)); }

void order_state_close(struct order_state *state) { free(state); }
