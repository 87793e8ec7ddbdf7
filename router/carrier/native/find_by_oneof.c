/* The payload is the last member of the envelope's oneof. Consecutive pieces of one member are merged, as protobuf does.
 *
 * BY_CASES, if there are `others`, envelope_part has to tell the messages apart. */
#include "find_case.h"

int find_by_oneof(const struct wire_schema *schema, const uint8_t *frame, struct envelope *envelope) {
    struct bytes rest = {frame, frame + envelope->size};
    if (envelope->size == 0 && !envelope->is_repaired) return EMPTY;
    uint32_t pieces = 0, unknown = 0, no_message = 0, first = 0;
    bool has_unknown = false;
    while (rest.at < rest.end) {
        uint32_t tag, begin = (uint32_t)(rest.at - frame);
        struct bytes value;
        if (!read_tag(&rest, &tag) || !read_value(&rest, tag & 7, &value)) return MALFORMED;
        uint32_t number = tag >> 3, wire_type = tag & 7;
        const struct wire_field *field = find_wire_field(&schema->types[0], number);
        bool is_case = field != NULL && (field->flags & WIRE_CASE);
        if (is_case && is_declared(field, wire_type)) {
            pieces = number == envelope->case_number ? pieces + 1 : 1;
            if (pieces == 1) first = begin;
            if (pieces == 1 && envelope->case_number != 0) envelope->others++;
            envelope->case_number = number;
            envelope->start = pieces == 1 ? (uint32_t)(value.at - frame) : first;
            envelope->length = (uint32_t)(value.end - frame) - envelope->start;
        } else if (!is_declared(field, wire_type)) {
            if (!has_unknown) unknown = number;
            has_unknown = true;
            if (is_case && field->kind == WIRE_MESSAGE && no_message == 0) no_message = number;
        }
    }
    if (envelope->case_number != 0) {
        envelope->is_single = pieces == 1;
        return -1;
    }
    if (!has_unknown) return NO_PAYLOAD;
    envelope->case_number = no_message ? no_message : unknown;
    return no_message ? MALFORMED : UNKNOWN_CASE;
}
