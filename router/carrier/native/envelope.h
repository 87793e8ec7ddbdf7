/* Finds the payload case of a datagram: repairs the framing, decides whether the envelope is well formed, with the same result
 * as the protobuf library, and which message it holds (find_case.h). */
#ifndef ENVELOPE_H
#define ENVELOPE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "wire.h"
#include "wire_schema.h"

enum { MAX_DATAGRAM = 16 * 1024 }; /* bytes; a longer datagram is rejected as TRUNCATED */

/* Reasons to reject a datagram, or a frame of a link: REJECT_REASONS in compiler/metrics.py. */
enum reason {
    TRUNCATED,
    EMPTY,
    MALFORMED,
    NO_PAYLOAD,
    UNKNOWN_CASE,
    UNHANDLED,
    IGNORED,
    SOURCE_MISMATCH,
    BAD_FRAME,
    BAD_CHECKSUM
};
enum { REASONS = BAD_CHECKSUM + 1 };

struct envelope {
    uint32_t case_number;
    uint32_t size;          /* with restored trailing zeros, without padding */
    uint32_t start, length; /* of the payload, or from the tag of its first piece to the end of its last one */
    uint32_t others;        /* payloads of other cases before it, which it supersedes except BY_CASES */
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

/* Of a frame that holds several messages (BY_CASES), write to `part` the first one whose case has a number above `after`: all
 * its pieces, and the fields beside the messages. Return false if there is none. */
bool envelope_part(const struct wire_schema *schema, struct bytes frame, uint32_t after, uint8_t *part,
                   struct envelope *envelope);

#endif
