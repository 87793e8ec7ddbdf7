/* Deferrals hold messages back for `on_limit: latest`, for the bandwidth of their endpoint (pace.h), or for both. A target
 * has a deferral for each source of its route.
 *
 * With `on_limit: latest`, at most one message passes per period, and the newest one in between is held until the next. A
 * held message is dropped as `rate_limited` when a newer one replaces it, as `stale` when it expires, and as `superseded`
 * when a newer command of a route that takes over is sent. A message is counted when it is sent or dropped, and feeds
 * deadmen when it is sent. */
#ifndef DEFER_H
#define DEFER_H

#include "deliver.h"
#include "pace.h"

/* Open the deferral of a target. Its first member is a struct timer; `pacer` is NULL without a bandwidth. It delivers to
 * the target that it adopts. Returns NULL if memory runs out. */
struct deferral *deferral_open(struct pacer *pacer);
void deferral_close(struct deferral *deferral);

/* Deliver a message to the target of a deferral, now or later: `data` is the machine's output, or a datagram. Return false
 * if the thread was abandoned. */
bool defer(struct thread_env *env, struct deferral *deferral, const uint8_t *data, size_t size, int64_t expires, int64_t now);

/* Drop what is held and queued of this deferral, and arrived before the command that is being sent. The lock is held. */
void deferral_supersede(struct timers *timers, struct deferral *deferral, int64_t now);

#endif
