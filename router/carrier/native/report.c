#include "report.h"

#include <string.h>

enum { MOST_EVENTS = 32, LONGEST_TEXT = 255 }; /* MOST_EVENTS: per EVENT_WINDOW */
static const int64_t EVENT_WINDOW = 10000000;

bool may_report(struct reporter *reporter, int64_t now) {
    if (now - reporter->window_began > EVENT_WINDOW) {
        reporter->window_began = now;
        reporter->left = MOST_EVENTS;
    }
    if (!reporter->left) return false;
    reporter->left--;
    return true;
}

void report_loss(struct reporter *reporter, int64_t now, const struct lost_event *lost, const char *text) {
    struct {
        struct lost_event event;
        char text[LONGEST_TEXT + 1];
    } record = {.event = *lost};
    if (!may_report(reporter, now)) return;
    size_t length = strnlen(text, LONGEST_TEXT);
    memcpy(record.text, text, length);
    record.event.kind = EVENT_LOST;
    record.event.size = (uint32_t)(sizeof record.event + (length + 8) / 8 * 8);
    ring_put(reporter->events, &record, record.event.size);
}
