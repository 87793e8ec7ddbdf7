/* Finds the payload case of a datagram: repairs the framing, and decides whether the envelope is well formed, with the same
 * result as the protobuf library. */
#ifndef ENVELOPE_H
#define ENVELOPE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { MAX_DATAGRAM = 16 * 1024 }; /* bytes; a longer datagram is rejected as TRUNCATED */

/* Reasons to reject a datagram: REJECT_REASONS in compiler/metrics.py. */
enum reason { TRUNCATED, EMPTY, MALFORMED, NO_PAYLOAD, UNKNOWN_CASE, UNHANDLED, IGNORED, SOURCE_MISMATCH };
enum { REASONS = SOURCE_MISMATCH + 1 };

/* The message types of an envelope, flattened by carrier/schema.py. */
struct wire_field {
    uint32_t number;
    uint8_t kind;  /* one of enum wire_kind */
    uint8_t flags; /* of enum wire_flag */
    uint16_t type; /* for a message or group: index of its type */
};
enum wire_kind { WIRE_VARINT, WIRE_I64, WIRE_I32, WIRE_BYTES, WIRE_STRING, WIRE_MESSAGE, WIRE_GROUP };
enum wire_flag {
    WIRE_PACKABLE = 1, /* a repeated scalar: its elements may be packed or not */
    WIRE_CASE = 2,     /* in the envelope: a member of the oneof of payloads */
    WIRE_ROUTED = 4,   /* a member that has a route, which is always a message */
};

struct wire_type {
    const struct wire_field *fields; /* by ascending number */
    uint32_t count;
    uint32_t accepts_zero; /* field number 0 is allowed, as in messages that declare no fields */
};

struct wire_schema {
    const struct wire_type *types; /* the first one is the envelope */
    uint32_t count;
};

struct envelope {
    uint32_t case_number;
    uint32_t size;          /* with restored trailing zeros, without padding */
    uint32_t start, length; /* of the payload, or from the tag of its first piece to the end of its last one */
    uint32_t superseded;    /* payloads before it, of other cases: protobuf keeps only the last member of a oneof */
    bool is_single;         /* the payload is in one piece */
    bool is_repaired;       /* `size` differs from that of the datagram; counted as padded, even without a payload */
};

/* Return the size of the envelope when it was encoded. The protocol allows a sender to omit zeros at the end, and boards may
 * send frames of a fixed size, padded with zeros. Both can be undone, because a tag is never zero and the last field states
 * its length.
 *
 * The result is the size of the datagram if that is complete, or cannot be such an envelope: it has a cut tag, groups, or a
 * field that would make it longer than MAX_DATAGRAM. */
size_t envelope_restored_size(const uint8_t *data, size_t size);

/* Find the payload case of a datagram of `size` bytes. `data` has room for MAX_DATAGRAM bytes; omitted zeros are written
 * after the datagram. `repairs`: the listener restores trimmed and padded frames.
 *
 * Return -1, or one of TRUNCATED, EMPTY, MALFORMED, NO_PAYLOAD and UNKNOWN_CASE. `case_number` is then the number of the
 * unknown field; if MALFORMED, that of a payload case that is not encoded as a message, or 0. */
int envelope_read(const struct wire_schema *schema, uint8_t *data, size_t size, bool repairs, struct envelope *envelope);

#endif
