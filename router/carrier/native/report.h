/* Reports losses and rejections as events (events.h). Their number is limited: in a flood, most are only counted. */
#ifndef REPORT_H
#define REPORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "events.h"
#include "ring.h"

/* The ring for a thread's events, and how many more it may write in this time window. */
struct reporter {
    struct ring *events;
    int64_t window_began;
    uint32_t left;
};

/* Whether another event may be written at `now` (boot clock). If so, the caller writes one. */
bool may_report(struct reporter *reporter, int64_t now);

/* Write an event of `size` bytes, followed by a text unless it is empty; sets its size. Return whether there was room. */
bool put_event(struct ring *events, const void *event, size_t size, const char *text);

/* Report a loss, with a text that gives details, or "". Sets its kind. */
void report_loss(struct reporter *reporter, int64_t now, struct lost_event lost, const char *text);

#endif
