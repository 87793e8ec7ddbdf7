/* `bandwidth`: a pacer sends to one endpoint, on average at most so many bytes of UDP payload per second.
 *
 * Datagrams that are no commands leave only when the budget for them is saved up, so they never overdraw it. At most 20 ms
 * of it are saved up, and beyond that the cost of the first datagrams that wait: the longest datagram passes the smallest
 * budget. A command leaves as long as no earlier command waits and the budget is overdrawn by 100 ms of it at most, or
 * 2048 bytes: it waits for commands only, and all others wait until the overdraft is paid.
 *
 * Waiting datagrams leave by priority, then by age. When more wait than there is room for, the oldest of the lowest
 * priority is dropped as `queue_full`; what expires meanwhile is dropped as `stale`. A datagram is charged also if sending
 * it fails. */
#ifndef PACE_H
#define PACE_H

#include <stdint.h>

#include "deliver.h"

/* In which order they leave. */
enum priority { PRIORITY_COMMAND, PRIORITY_TELEMETRY, PRIORITY_BULK };
enum { PRIORITIES = PRIORITY_BULK + 1 };

/* How many bytes may wait: 1 s of the bandwidth, within these bounds; and how many datagrams: one for so many bytes. */
enum { LEAST_ROOM = 1 << 16, MOST_ROOM = 1 << 24, BYTES_PER_WAITING = 16 };

enum { LONGEST_SENT = 65507 }; /* by UDP over IPv4 */

/* A target of a route. Of one whose messages wait, it may change to that of the next program. */
struct route_target {
    const struct targets *to;
    const struct target *target;
};

struct pacer;

/* Open a pacer, a timer, for a bandwidth in bytes per second. NULL for lack of memory. */
struct pacer *pacer_open(int64_t bandwidth);
void pacer_close(struct pacer *pacer);

/* Both with the lock of the group held. Send a datagram of up to LONGEST_SENT bytes now or later, or drop it; and send at
 * once all that waits for `of`, whatever the budget. */
void pacer_queue(struct timers *timers, struct pacer *pacer, const struct route_target *of, const uint8_t *data, size_t size,
                 int64_t expires, int64_t now);
void pacer_release(struct timers *timers, struct pacer *pacer, const struct route_target *of, int64_t now);

#endif
