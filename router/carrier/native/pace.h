/* `bandwidth`: a pacer limits the average number of bytes of UDP payload per second to one endpoint.
 *
 * Datagrams other than commands are sent only when enough budget has accumulated, so they never overdraw it. At most 20 ms
 * of the budget accumulate, or more if the first waiting datagrams need it, so the longest datagram passes the smallest
 * budget. A command is sent if no earlier command waits and the budget is overdrawn by at most 100 ms of it, or 2048 bytes:
 * commands wait only for commands, and all other datagrams wait until the overdraft is paid.
 *
 * Waiting datagrams are sent by priority, then by age. If there is no room, the oldest one of the lowest priority is dropped
 * as `queue_full`; datagrams that expire are dropped as `stale`. A datagram is charged even if sending it fails.
 *
 * Each leaves as soon as the budget has paid for it. */
#ifndef PACE_H
#define PACE_H

#include <stdint.h>

#include "deliver.h"

/* The order of sending. */
enum priority { PRIORITY_COMMAND, PRIORITY_TELEMETRY, PRIORITY_BULK };
enum { PRIORITIES = PRIORITY_BULK + 1 };

/* Bounds of the bytes that may wait, which are 1 s of the bandwidth; and bytes per datagram that may wait. */
enum { LEAST_ROOM = 1 << 16, MOST_ROOM = 1 << 24, BYTES_PER_WAITING = 16 };

enum { LONGEST_SENT = 65507 }; /* by UDP over IPv4 */

/* A target of a route. While its messages wait, a reload may replace it with the target of the next program. */
struct route_target {
    const struct targets *to;
    const struct target *target;
    uint32_t queued; /* by its pacer */
};

struct pacer;

/* Open a pacer for a bandwidth in bytes per second. Its first member is a struct timer. Returns NULL if memory runs out. */
struct pacer *pacer_open(int64_t bandwidth);
void pacer_close(struct pacer *pacer);

/* Call these with the lock of the group held. `pacer_queue` sends a datagram of up to LONGEST_SENT bytes now or later, or
 * drops it; `pacer_release` sends all waiting datagrams of `of` at once, whatever the budget; `pacer_supersede` drops those
 * that arrived before the command that is being sent. */
void pacer_queue(struct timers *timers, struct pacer *pacer, struct route_target *of, const uint8_t *data, size_t size,
                 int64_t expires, int64_t now);
void pacer_release(struct timers *timers, struct pacer *pacer, const struct route_target *of, int64_t now);
void pacer_supersede(struct timers *timers, struct pacer *pacer, const struct route_target *of, int64_t now);

void lose_superseded(struct thread_env *env, const struct route_target *of, int64_t now);

#endif
