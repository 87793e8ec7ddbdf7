/* A libFuzzer target: `envelope_read` reads and writes only what it may, and returns only what envelope.h says.
 *
 * Bit 0 of an input's first byte is `repairs`, the rest of the byte chooses a schema; the datagram follows. */
#include <stdlib.h>
#include <string.h>

#include "envelope.h"
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
    if (envelope->is_single) demand(envelope->start + envelope->length == envelope->size);
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    if (size == 0) return -1;
    bool repairs = input[0] & 1;
    const struct wire_schema *schema = &schemas[(input[0] >> 1) % SCHEMA_COUNT];
    const uint8_t *sent = input + 1;
    size--;
    /* Where nothing may be written behind the datagram, the sanitizer sees what is read there. */
    static uint8_t room[MAX_DATAGRAM];
    uint8_t *exact = repairs && size <= MAX_DATAGRAM ? NULL : malloc(size ? size : 1);
    uint8_t *data = exact ? exact : room;
    memcpy(data, sent, size);
    struct envelope envelope;
    int reason = envelope_read(schema, data, size, repairs, &envelope);
    demand(reason >= -1 && reason <= UNKNOWN_CASE);
    demand((reason == TRUNCATED) == (size > MAX_DATAGRAM));
    demand((reason == EMPTY) == (size == 0));
    demand(repairs || !envelope.is_repaired);
    if (reason == -1) {
        demand(envelope.case_number != 0);
        check_envelope(&envelope, data, sent, size);
    } else {
        demand(!envelope.is_single);
    }
    free(exact);
    return 0;
}
