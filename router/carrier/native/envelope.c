/* Checks the wire format of protobuf (wire.h) as the protobuf library (upb) does to parse a message.
 *
 * A field whose number or wire type is not declared is unknown: it is skipped, but must be well formed. */
#include "envelope.h"

#include "find_case.h"
#include "utf8.h"
#include "wire.h"

#include <string.h>

enum { MOST_LEVELS = 100 /* of nested messages and groups, known or unknown */ };

/* Whether packed scalars are whole. */
static bool is_packed(uint8_t kind, struct bytes values) {
    if (kind == WIRE_I64) return bytes_left(&values) % 8 == 0;
    if (kind == WIRE_I32) return bytes_left(&values) % 4 == 0;
    uint64_t value;
    while (values.at < values.end) {
        if (!read_varint(&values, LONGEST_VARINT, &value)) return false;
    }
    return true;
}

/* A message or group whose fields are being read. */
struct level {
    const uint8_t *end;           /* for a group: of the enclosing message */
    const struct wire_type *type; /* NULL in an unknown group */
    int64_t group;                /* the group's number, or NO_GROUP */
};
enum { NO_GROUP = -1 };

struct walk {
    const struct wire_schema *schema;
    struct bytes rest; /* of the innermost level */
    unsigned depth;
    struct level levels[MOST_LEVELS + 1];
};

static bool enter(struct walk *walk, const uint8_t *end, const struct wire_type *type, int64_t group) {
    if (walk->depth == MOST_LEVELS) return false;
    walk->levels[++walk->depth] = (struct level){end, type, group};
    walk->rest.end = end;
    return true;
}

static void leave(struct walk *walk) { walk->rest.end = walk->levels[--walk->depth].end; }

/* Read the value of a LEN field, or enter it if it is a message. */
static bool read_known_len(struct walk *walk, const struct wire_type *type, uint32_t number) {
    struct bytes value;
    if (!read_len(&walk->rest, &value)) return false;
    const struct wire_field *field = type ? find_wire_field(type, number) : NULL;
    if (field == NULL) return true;
    if (field->kind == WIRE_MESSAGE) {
        walk->rest.at = value.at;
        return enter(walk, value.end, &walk->schema->types[field->type], NO_GROUP);
    }
    if (field->kind == WIRE_STRING) return is_utf8(value.at, bytes_left(&value));
    if (field->flags & WIRE_PACKABLE) return is_packed(field->kind, value);
    return true;
}

static bool enter_group(struct walk *walk, const struct wire_type *type, uint32_t number) {
    const struct wire_field *field = type ? find_wire_field(type, number) : NULL;
    bool is_known = field != NULL && field->kind == WIRE_GROUP;
    return enter(walk, walk->rest.end, is_known ? &walk->schema->types[field->type] : NULL, number);
}

/* Skip scalars with a tag of one byte, as most fields are. Stops at any other field, and at a malformed one. */
static inline void skip_usual_scalars(struct bytes *bytes) {
    while (bytes->at < bytes->end && *bytes->at >= 1 << 3 && *bytes->at < 0x80) {
        struct bytes rest = {bytes->at + 1, bytes->end};
        if (!skip_scalar(&rest, *bytes->at & 7)) return;
        bytes->at = rest.at;
    }
}

static bool read_field(struct walk *walk) {
    const struct level *level = &walk->levels[walk->depth];
    uint32_t tag;
    if (!read_tag(&walk->rest, &tag)) return false;
    uint32_t number = tag >> 3, wire_type = tag & 7;
    /* protobuf ignores field numbers in unknown groups and in messages that declare no fields. */
    if (number == 0 && level->type != NULL && !level->type->accepts_zero) return false;
    if (wire_type == LEN) return read_known_len(walk, level->type, number);
    if (wire_type == GROUP) return enter_group(walk, level->type, number);
    if (wire_type == GROUP_END) {
        if (level->group != number) return false;
        leave(walk);
        return true;
    }
    return skip_scalar(&walk->rest, wire_type);
}

bool is_well_formed(const struct wire_schema *schema, const struct wire_type *type, struct bytes message) {
    struct walk walk; /* only entered levels are initialized, as it is large */
    walk.schema = schema;
    walk.rest = message;
    walk.depth = 0;
    walk.levels[0] = (struct level){message.end, type, NO_GROUP};
    for (;;) {
        skip_usual_scalars(&walk.rest);
        if (walk.rest.at < walk.rest.end) {
            if (!read_field(&walk)) return false;
        } else if (walk.levels[walk.depth].group != NO_GROUP) {
            return false;
        } else if (walk.depth > 0) {
            leave(&walk);
        } else {
            return true;
        }
    }
}

/* Whether the datagram contains only the payload of a routed case, with a tag and a size of at most two bytes, as usual. The
 * payload is then parsed alone, and may have one level more than within the envelope. */
static bool is_usual(const struct wire_schema *schema, const uint8_t *data, struct envelope *envelope) {
    struct bytes rest = {data, data + envelope->size};
    uint64_t tag, size;
    if (!read_varint(&rest, 2, &tag) || (tag & 7) != LEN) return false;
    const struct wire_field *field = find_wire_field(&schema->types[0], (uint32_t)tag >> 3);
    if (field == NULL || !(field->flags & WIRE_ROUTED)) return false;
    if (!read_varint(&rest, 2, &size) || size != bytes_left(&rest)) return false;
    if (!is_well_formed(schema, &schema->types[field->type], rest)) return false;
    envelope->case_number = field->number;
    envelope->start = (uint32_t)(rest.at - data);
    envelope->length = (uint32_t)size;
    envelope->is_single = true;
    return true;
}

static bool is_zeros(const struct bytes *bytes) {
    for (const uint8_t *at = bytes->at; at < bytes->end; at++) {
        if (*at != 0) return false;
    }
    return true;
}

size_t envelope_restored_size(const uint8_t *data, size_t size) {
    struct bytes rest = {data, data + size};
    while (rest.at < rest.end) {
        uint64_t tag, length = 0;
        size_t missing = 0; /* zeros of a length or value */
        if (*rest.at == 0) return is_zeros(&rest) ? (size_t)(rest.at - data) : size;
        if (!read_varint(&rest, LONGEST_VARINT, &tag)) return size;
        switch (tag & 7) {
        case I64: length = 8; break;
        case I32: length = 4; break;
        case VARINT:
            missing = rest.at == rest.end;
            if (!missing && !read_varint(&rest, LONGEST_VARINT, &length)) return size;
            length = 0;
            break;
        case LEN:
            missing = !read_varint(&rest, LONGEST_SIZE, &length); /* `c2 01 80` was `c2 01 80 00` */
            if (missing && rest.at < rest.end) return size;
            break;
        default: return size;
        }
        if (length > MAX_DATAGRAM) return size;
        size_t end = (size_t)(rest.at - data) + missing + (size_t)length;
        if (end > size) return end <= MAX_DATAGRAM ? end : size;
        rest.at = data + end;
    }
    return size;
}

static int (*const FIND_CASE[])(const struct wire_schema *schema, const uint8_t *frame, struct envelope *envelope) = {
    [BY_ONEOF] = find_by_oneof,
    [BY_CASES] = find_by_oneof,
    [BY_FRAME] = find_by_frame,
    [BY_NAME] = find_by_name,
};

int envelope_read(const struct wire_schema *schema, uint8_t *data, size_t size, bool repairs,
                  struct envelope *envelope) {
    *envelope = (struct envelope){.size = (uint32_t)size};
    if (size > MAX_DATAGRAM) return TRUNCATED;
    if (is_usual(schema, data, envelope)) return -1;
    size_t whole = repairs ? envelope_restored_size(data, size) : size;
    if (whole > size) memset(data + size, 0, whole - size);
    if (!is_well_formed(schema, &schema->types[0], (struct bytes){data, data + whole})) return MALFORMED;
    envelope->size = (uint32_t)whole;
    envelope->is_repaired = whole != size;
    return FIND_CASE[schema->case_by](schema, data, envelope);
}

/* The number of the payload case that a field is, or 0. */
static uint32_t case_of(const struct wire_schema *schema, uint32_t tag) {
    const struct wire_field *field = find_wire_field(&schema->types[0], tag >> 3);
    return field != NULL && (field->flags & WIRE_CASE) && is_declared(field, tag & 7) ? tag >> 3 : 0;
}

static bool read_field_of(struct bytes *rest, uint32_t *tag) {
    struct bytes value;
    return read_tag(rest, tag) && read_value(rest, *tag & 7, &value);
}

static uint32_t next_case(const struct wire_schema *schema, struct bytes frame, uint32_t after) {
    uint32_t next = 0, tag;
    while (frame.at < frame.end && read_field_of(&frame, &tag)) {
        uint32_t number = case_of(schema, tag);
        if (number > after && (next == 0 || number < next)) next = number;
    }
    return next;
}

bool envelope_part(const struct wire_schema *schema, struct bytes frame, uint32_t after, uint8_t *part,
                   struct envelope *envelope) {
    uint32_t next = next_case(schema, frame, after), tag;
    if (next == 0) return false;
    *envelope = (struct envelope){0};
    while (frame.at < frame.end) {
        const uint8_t *begin = frame.at;
        if (!read_field_of(&frame, &tag)) return false;
        uint32_t number = case_of(schema, tag), size = (uint32_t)(frame.at - begin);
        if (number != 0 && number != next) continue;
        memcpy(part + envelope->size, begin, size);
        envelope->size += size;
    }
    return find_by_oneof(schema, part, envelope) < 0;
}
