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

bool put_event(struct ring *events, const void *event, size_t size, const char *text) {
    struct {
        _Alignas(8) struct event_head head;
        char rest[sizeof(struct lost_event) + LONGEST_TEXT + 1]; /* the longest event with a text */
    } record = {0};
    size_t length = strnlen(text, LONGEST_TEXT);
    memcpy(&record, event, size);
    memcpy((char *)&record + size, text, length);
    record.head.size = padded_to_word(size + (length ? length + 1 : 0));
    return ring_put(events, &record, record.head.size);
}

void report_loss(struct reporter *reporter, int64_t now, struct lost_event lost, const char *text) {
    lost.kind = EVENT_LOST;
    if (may_report(reporter, now)) put_event(reporter->events, &lost, sizeof lost, text);
}
