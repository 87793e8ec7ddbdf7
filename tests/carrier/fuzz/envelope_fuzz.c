/* A libFuzzer target: `envelope_read` reads and writes only what it may, and returns only what envelope.h says.
 *
 * An input is a datagram. Each is read by all schemas, by a listener that repairs and by one that does not. */
#include <stdlib.h>
#include <string.h>

#include "envelope.h"
#include "outcome.h"
#include "schemas.h"

static void demand(bool condition) {
    if (!condition) abort();
}

static void check_envelope(const struct envelope *envelope, const uint8_t *data, const uint8_t *sent, size_t size) {
    demand(envelope->size <= MAX_DATAGRAM);
    demand(envelope->is_repaired == (envelope->size != size));
    demand(memcmp(data, sent, size) == 0);
    for (size_t index = size; index < envelope->size; index++) demand(data[index] == 0);
    for (size_t index = envelope->size; index < size; index++) demand(data[index] == 0);
    if (envelope->is_single) demand(envelope->start + envelope->length <= envelope->size);
}

/* `data` has room for MAX_DATAGRAM bytes where `repairs`, else for `size` bytes. */
static void check(const struct wire_schema *schema, uint8_t *data, const uint8_t *sent, size_t size, bool repairs) {
    struct envelope envelope;
    int reason = envelope_read(schema, data, size, repairs, &envelope);
    demand(reason >= -1 && reason <= UNKNOWN_CASE);
    note_outcome(&reason, sizeof reason);
    demand((reason == TRUNCATED) == (size > MAX_DATAGRAM));
    demand(reason != EMPTY || size == 0);
    demand(repairs || !envelope.is_repaired);
    if (reason == -1) {
        demand(envelope.case_number != 0);
        check_envelope(&envelope, data, sent, size);
        uint32_t found[] = {envelope.case_number, envelope.start, envelope.length, envelope.size, envelope.is_single};
        note_outcome(found, sizeof found);
    } else {
        demand(!envelope.is_single);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *sent, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *sent, size_t size) {
    static uint8_t room[MAX_DATAGRAM];
    /* Of the datagram's own length, so that the sanitizer sees what is read behind it. */
    uint8_t *exact = malloc(size ? size : 1);
    if (exact == NULL) return -1;
    if (size > 0) memcpy(exact, sent, size);
    for (size_t index = 0; index < SCHEMA_COUNT; index++) {
        check(&schemas[index], exact, sent, size, false);
        if (size > MAX_DATAGRAM) continue;
        if (size > 0) memcpy(room, sent, size);
        check(&schemas[index], room, sent, size, true);
    }
    free(exact);
    return 0;
}
