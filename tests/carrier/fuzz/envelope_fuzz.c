/* A libFuzzer target: `envelope_read` and `envelope_part` read and write only what they may, and return only what envelope.h
 * says.
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

/* A part is an envelope with this message only. */
static void check_part(const struct wire_schema *schema, uint8_t *part, const struct envelope *found) {
    struct envelope again;
    demand(envelope_read(schema, part, found->size, false, &again) == -1);
    demand(again.case_number == found->case_number && again.size == found->size && again.others == 0);
    demand(again.start == found->start && again.length == found->length && again.is_single == found->is_single);
    demand(found->start + found->length <= found->size && found->others == 0);
}

/* Together the parts have each message once, and each of them what is beside the messages. */
static void check_parts(const struct wire_schema *schema, const uint8_t *data, const struct envelope *whole) {
    struct bytes frame = {data, data + whole->size};
    uint8_t *part = malloc(whole->size); /* of its own length, so that the sanitizer sees what is written behind it */
    if (part == NULL) return;
    struct envelope found;
    uint32_t count = 0, after = 0;
    size_t sizes = 0;
    for (; envelope_part(schema, frame, after, part, &found); after = found.case_number) {
        demand(found.case_number > after && found.size <= whole->size);
        note_outcome(part, found.size);
        check_part(schema, part, &found);
        sizes += found.size;
        count++;
    }
    demand(count > 0 && (count == 1) == (whole->others == 0));
    demand(count == 1 ? sizes == whole->size : sizes >= whole->size && (sizes - whole->size) % (count - 1) == 0);
    free(part);
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
        if (schema->case_by == BY_CASES) check_parts(schema, data, &envelope);
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
