/* Datagrams to payload cases: repair of the framing, and the decision whether an envelope is well formed.
 *
 * The decision is that of the protobuf library, so that what is forwarded is what the generated handlers would forward:
 * engine/dispatch.py and engine/slow_path.py have to give the same answers. */
#ifndef ENVELOPE_H
#define ENVELOPE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { MAX_DATAGRAM = 16 * 1024 };

/* Reasons to reject a datagram, in the order of REJECT_REASONS in compiler/metrics.py. */
enum reason { TRUNCATED, EMPTY, MALFORMED, NO_PAYLOAD, UNKNOWN_CASE, UNHANDLED, IGNORED, SOURCE_MISMATCH, REASONS };

/* The message types of an envelope, flattened. Type 0 is the envelope. */
struct wire_field {
    uint32_t number;
    uint8_t kind;       /* one of enum wire_kind */
    uint8_t is_packable; /* a repeated scalar: elements may come alone or packed */
    uint16_t type;      /* of a message or group: index of its type */
};
enum wire_kind { WIRE_VARINT, WIRE_I64, WIRE_I32, WIRE_BYTES, WIRE_STRING, WIRE_MESSAGE, WIRE_GROUP };

struct wire_type {
    const struct wire_field *fields; /* by ascending number */
    uint32_t count;
};

struct wire_schema {
    const struct wire_type *types;
    uint32_t count;
    const uint32_t *cases; /* field numbers of the oneof, ascending */
    uint32_t case_count;
};

struct envelope {
    uint32_t case_number;
    uint32_t size;          /* with the trailing zeros that were put back, without those that were padding */
    uint32_t start, length; /* of the payload, where it is the only field */
    bool is_single;
    bool is_repaired;       /* `size` is not that of the datagram */
};

/* Find the payload case of a datagram of `size` bytes. `data` has room for MAX_DATAGRAM bytes; zeros that were left
 * out are written behind the datagram. `repairs`: the listener restores trimmed and padded frames.
 *
 * Return -1, or one of TRUNCATED, EMPTY, MALFORMED, NO_PAYLOAD and UNKNOWN_CASE (`case_number` is then the unknown
 * field's). */
int envelope_read(const struct wire_schema *schema, uint8_t *data, size_t size, bool repairs, struct envelope *envelope);

#endif
