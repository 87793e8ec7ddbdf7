/* The frame is the message of the only payload case, even a frame of 0 bytes: a message with all defaults. */
#include "find_case.h"

int find_by_frame(const struct wire_schema *schema, const uint8_t *frame, struct envelope *envelope) {
    (void)schema;
    (void)frame;
    envelope->case_number = ONLY_CASE;
    envelope->length = envelope->size;
    envelope->is_single = true;
    return -1;
}
