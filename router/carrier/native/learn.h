/* Endpoints whose address is learned: that of the first sender of a message for a route that names the endpoint as its source.
 *
 * A sender is an address and a port. Until it has been silent for `stale_after`, all others are strangers; then the next one
 * takes its origin. What was learned is a counter of the thread that receives, so a reload keeps it. */
#ifndef LEARN_H
#define LEARN_H

#include <stdbool.h>
#include <stdint.h>

#include "program.h"

/* Where an endpoint was learned to be; address and port are 0 before that. */
struct origin {
    uint32_t address, port;
};
struct origin learned_origin(const struct thread_env *env, const struct learned_peer *learned);

/* Return the endpoint of the listener that was learned to send from there, or NULL. */
const struct peer *learned_at(const struct thread_env *env, const struct listener *listener, struct origin origin);

/* Whether the endpoint may be learned at `now` (boot clock, ns) to send from there. */
bool may_learn(const struct thread_env *env, const struct learned_peer *learned, struct origin origin, int64_t now);

/* Send to the endpoint there from now on, and report that. */
void learn(struct thread_env *env, const struct learned_peer *learned, struct origin origin);

/* Send where the endpoint was learned to be under the earlier program. If its settings exclude that, or if another endpoint has
 * the address now (`is_taken`), it is forgotten. */
void learned_adopt(struct thread_env *env, const struct learned_peer *learned, bool is_taken);

#endif
