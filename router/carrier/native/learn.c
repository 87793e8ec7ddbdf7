#include "learn.h"

#include <string.h>

#include "events.h"
#include "hosts.h"
#include "report.h"

static uint64_t packed(struct origin origin) { return (uint64_t)origin.address << 16 | origin.port; }

struct origin learned_origin(const struct thread_env *env, const struct learned_peer *learned) {
    uint64_t word = (uint64_t)atomic_load_explicit(&env->counters[learned->origin], memory_order_relaxed);
    return (struct origin){(uint32_t)(word >> 16), (uint32_t)(word & 0xffff)};
}

static bool is_same(struct origin one, struct origin other) { return packed(one) == packed(other); }

const struct peer *learned_at(const struct thread_env *env, const struct listener *listener, struct origin origin) {
    for (uint32_t index = 0; index < listener->learned_count; index++)
        if (is_same(learned_origin(env, &listener->learned[index]), origin)) return &listener->learned[index].peer;
    return NULL;
}

static bool is_in(const uint8_t *host, const struct network *network) {
    uint32_t whole = network->prefix / 8, rest = network->prefix % 8;
    if (memcmp(host, network->address, whole)) return false;
    return !rest || !((host[whole] ^ network->address[whole]) >> (8 - rest));
}

/* Whether the settings of the endpoint allow that it sends from there. A sender without a port cannot be answered, nor one
 * whose address is not known. */
static bool is_allowed(const struct learned_peer *learned, struct origin origin) {
    uint8_t host[HOST_BYTES];
    if (!origin.port || (learned->port && learned->port != origin.port) || !host_bytes(origin.address, host)) return false;
    for (uint32_t index = 0; index < learned->network_count; index++)
        if (is_in(host, &learned->networks[index])) return true;
    return !learned->network_count;
}

bool may_learn(const struct thread_env *env, const struct learned_peer *learned, struct origin origin, int64_t now) {
    if (!is_allowed(learned, origin)) return false;
    int64_t last_seen = atomic_load_explicit(&env->counters[learned->peer.last_seen], memory_order_relaxed);
    return !learned_origin(env, learned).port || now - last_seen > learned->stale_after;
}

static void aim(const struct learned_peer *learned, struct origin origin) {
    if (learned->sender) sender_aim(learned->sender, origin.address, (uint16_t)origin.port);
}

void learn(struct thread_env *env, const struct learned_peer *learned, struct origin origin) {
    struct learned_event event = {.kind = EVENT_LEARNED, .endpoint = learned->peer.id,
                                  .before = packed(learned_origin(env, learned)), .after = packed(origin)};
    counter_set(env->counters, learned->origin, (int64_t)event.after);
    aim(learned, origin);
    put_event(env->reporter.events, &event, sizeof event, "");
}

void learned_adopt(struct thread_env *env, const struct learned_peer *learned, bool is_taken) {
    struct origin origin = learned_origin(env, learned);
    if (origin.port && (is_taken || !is_allowed(learned, origin))) learn(env, learned, (struct origin){0, 0});
    else aim(learned, origin);
}
