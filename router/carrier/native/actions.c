#include "actions.h"

#include <stdlib.h>
#include <string.h>

#include "clock.h"
#include "envelope.h"
#include "timers.h"

struct actions {
    pthread_mutex_t lock;
    struct ring *ring;
    _Atomic uint32_t lost; /* counter */
    _Alignas(8) uint8_t record[sizeof(struct action_record) + MAX_DATAGRAM + 8];
};

struct actions *actions_open(struct ring *ring) {
    struct actions *actions = calloc(1, sizeof *actions);
    if (!actions) return NULL;
    actions->ring = ring;
    if (!lock_open(&actions->lock)) return actions;
    free(actions);
    return NULL;
}

void actions_count_lost(struct actions *actions, uint32_t lost) {
    atomic_store_explicit(&actions->lost, lost, memory_order_relaxed);
}

void actions_note(struct actions *actions, counter *counters, struct action_record action, const void *data, size_t length) {
    action.length = (uint32_t)(length < MAX_DATAGRAM ? length : MAX_DATAGRAM);
    action.size = padded_to_word(sizeof action + action.length);
    pthread_mutex_lock(&actions->lock);
    action.at = wall_ns();
    memcpy(actions->record, &action, sizeof action);
    if (action.length) memcpy(actions->record + sizeof action, data, action.length);
    bool has_room = ring_put(actions->ring, actions->record, action.size);
    pthread_mutex_unlock(&actions->lock);
    if (!has_room) counter_add(counters, atomic_load_explicit(&actions->lost, memory_order_relaxed), 1);
}
