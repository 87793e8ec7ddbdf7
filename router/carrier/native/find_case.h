/* Finds the payload case of a frame: one function for each `enum case_by`, in a file of its own.
 *
 * The frame is a well-formed envelope of `envelope->size` bytes, with restored zeros if `is_repaired`. All other members of
 * `envelope` are 0. The functions only read their arguments, and return as envelope_read does. */
#ifndef FIND_CASE_H
#define FIND_CASE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "envelope.h"
#include "wire.h"
#include "wire_schema.h"

int find_by_oneof(const struct wire_schema *schema, const uint8_t *frame, struct envelope *envelope);
int find_by_frame(const struct wire_schema *schema, const uint8_t *frame, struct envelope *envelope);
int find_by_name(const struct wire_schema *schema, const uint8_t *frame, struct envelope *envelope);

/* Whether protobuf would parse a message of this type. */
bool is_well_formed(const struct wire_schema *schema, const struct wire_type *type, struct bytes message);

static inline const struct wire_field *find_wire_field(const struct wire_type *type, uint32_t number) {
    const struct wire_field *fields = type->fields;
    /* Most types number their fields from 1 without gaps. For number 0 the index wraps around. */
    if (number - 1 < type->count && fields[number - 1].number == number) return &fields[number - 1];
    uint32_t low = 0, high = type->count;
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        if (fields[middle].number == number) return &fields[middle];
        if (fields[middle].number < number) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    return NULL;
}

/* Whether a field is declared, with this wire type. */
static inline bool is_declared(const struct wire_field *field, uint32_t wire_type) {
    if (field == NULL) return false;
    switch (wire_type) {
    case VARINT: return field->kind == WIRE_VARINT;
    case I64: return field->kind == WIRE_I64;
    case I32: return field->kind == WIRE_I32;
    case GROUP: return field->kind == WIRE_GROUP;
    default:
        return field->kind == WIRE_BYTES || field->kind == WIRE_STRING || field->kind == WIRE_MESSAGE ||
               (field->flags & WIRE_PACKABLE) != 0;
    }
}

#endif
