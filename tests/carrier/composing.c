/* The publish thread without its thread and the middleware: tests have it compose messages. */
#include "publishing.c"

struct publishing *seam_composing_open(counter *counters);
void seam_composing_close(struct publishing *publishing);
bool seam_compose(struct publishing *publishing, const struct publish_route *route, uint32_t target, const void *data,
                  uint32_t size, bool is_single, int64_t received_at, const uint8_t **message, size_t *message_size);

struct publishing *seam_composing_open(counter *counters) {
    struct publishing *publishing = calloc(1, sizeof *publishing);
    if (!publishing) return NULL;
    publishing->counters = counters;
    publishing->reporter.events = ring_open(4096);
    if (composer_open(&publishing->composer) && publishing->reporter.events) return publishing;
    composer_close(&publishing->composer);
    free(publishing);
    return NULL;
}

void seam_composing_close(struct publishing *publishing) {
    ring_close(publishing->reporter.events);
    composer_close(&publishing->composer);
    free(publishing);
}

/* Compose the message of a target, from a payload if `is_single`, else from an envelope. Return whether there is one,
 * which is valid until the next call; else it is counted. */
bool seam_compose(struct publishing *publishing, const struct publish_route *route, uint32_t target, const void *data,
                  uint32_t size, bool is_single, int64_t received_at, const uint8_t **message, size_t *message_size) {
    struct message_record *record = calloc(1, sizeof *record + size); /* exactly, for sanitizers */
    if (!record) return false;
    record->received_at = received_at;
    record->is_single = is_single;
    record->length = record->payload_length = size;
    if (size) memcpy(record + 1, data, size);
    struct served served = {.record = record, .route = route, .expires = NEVER};
    bool is_made = is_composed(publishing, &served, &route->targets[target]);
    *message = publishing->composer.message.data;
    *message_size = publishing->composer.message.size;
    free(record);
    return is_made;
}
