#include "priority.h"

#include <sched.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "clock.h"

/* `struct sched_attr` of sched_setattr(2), which C libraries declare only since 2024. */
struct scheduling {
    uint32_t size, policy;
    uint64_t flags;
    int32_t nice;
    uint32_t priority;
    uint64_t runtime, deadline, period;
};

static const uint64_t SLICE = 100000; /* ns, the shortest that Linux accepts */
static const int64_t TURN = 100000000; /* ns */

static bool take_priority(void) {
    struct sched_param least = {.sched_priority = sched_get_priority_min(SCHED_FIFO)};
    return !sched_setscheduler(0, SCHED_FIFO, &least);
}

static void take_usual_policy(void) { sched_setscheduler(0, SCHED_OTHER, &(struct sched_param){0}); }

static void take_short_slices(void) {
    struct scheduling wanted = {.size = sizeof wanted, .policy = SCHED_OTHER, .runtime = SLICE};
    wanted.nice = getpriority(PRIO_PROCESS, 0);
    if (!syscall(SYS_sched_setattr, 0, &wanted, 0)) return;
    take_usual_policy();
}

/* Whether the router was started with the default policy. A Python thread that opens ROS passes on the batch policy. */
static bool has_usual_policy(void) {
    int inherited = sched_getscheduler(0);
    return inherited == SCHED_OTHER || inherited == SCHED_BATCH;
}

void run_in_turn(void) {
    if (has_usual_policy()) take_usual_policy();
}

void run_soon(void) {
    if (has_usual_policy()) take_short_slices(); /* has no effect before Linux 6.12 */
}

bool run_first(void) {
    if (!has_usual_policy()) return false;
    if (take_priority()) return true;
    run_soon();
    return false;
}

void share_processor(struct share *share, int64_t now) {
    if (!share->may_be_first || now - share->began < TURN) return;
    int64_t used = clock_read(CLOCK_THREAD_CPUTIME_ID);
    bool was_busy = used - share->used > (now - share->began) / 4 * 3;
    if (was_busy && share->is_first) take_short_slices();
    else if (!was_busy && !share->is_first) take_priority();
    share->is_first = !was_busy;
    share->began = now;
    share->used = used;
}
