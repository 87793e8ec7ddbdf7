/* What a thread tells of losses and rejections, as events (events.h). A flood is counted, not reported. */
#ifndef REPORT_H
#define REPORT_H

#include <stdbool.h>
#include <stdint.h>

#include "events.h"
#include "ring.h"

/* Of one thread: where it reports, and how many events it may still write in this window of time. */
struct reporter {
    struct ring *events;
    int64_t window_began;
    uint32_t left;
};

/* Whether another event may be written at the time `now` (boot clock), which is then to be done. */
bool may_report(struct reporter *reporter, int64_t now);

/* Report a loss, whose size and kind are filled in here, with a text that says more, or "". */
void report_loss(struct reporter *reporter, int64_t now, const struct lost_event *lost, const char *text);

#endif
