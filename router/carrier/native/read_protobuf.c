#include "read_protobuf.h"

#include <string.h>

#include "lists.h"
#include "wire.h"

/* Find a field. Most messages have their fields in order, so `guess` is the index after the last one found. */
static const struct wanted_field *find(const struct section *section, uint32_t number, uint32_t *guess) {
    if (*guess < section->count && section->fields[*guess].number == number) return &section->fields[(*guess)++];
    uint32_t low = 0, high = section->count;
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        if (section->fields[middle].number < number) low = middle + 1;
        else high = middle;
    }
    if (low == section->count || section->fields[low].number != number) return NULL;
    *guess = low + 1;
    return &section->fields[low];
}

static uint32_t wire_type_of(enum field_type type) {
    switch (type) {
    case TYPE_FIXED32:
    case TYPE_SFIXED32:
    case TYPE_FLOAT: return I32;
    case TYPE_FIXED64:
    case TYPE_DOUBLE: return I64;
    case TYPE_BYTES:
    case TYPE_MESSAGE: return LEN;
    case TYPE_GROUP: return GROUP;
    default: return VARINT;
    }
}

static int64_t of_zigzag(uint64_t bits) { return (int64_t)(bits >> 1 ^ (bits & 1 ? UINT64_MAX : 0)); }

/* The value of a scalar's bits, as in protobuf. */
static struct value scalar(enum field_type type, uint64_t bits) {
    switch (type) {
    case TYPE_BOOL: return (struct value){.integer = bits != 0};
    case TYPE_INT32:
    case TYPE_SFIXED32:
    case TYPE_CLOSED_ENUM: return (struct value){.integer = (int32_t)(uint32_t)bits};
    case TYPE_UINT32: return (struct value){.integer = (uint32_t)bits};
    case TYPE_SINT32: return (struct value){.integer = (int32_t)of_zigzag((uint32_t)bits)};
    case TYPE_SINT64: return (struct value){.integer = of_zigzag(bits)};
    case TYPE_FLOAT: return (struct value){.real = of_float32(bits)};
    case TYPE_DOUBLE: return (struct value){.real = of_float64(bits)};
    default: return (struct value){.integer = (int64_t)bits};
    }
}

static bool read_scalar(struct bytes *from, enum field_type type, struct value *value) {
    uint32_t wire_type = wire_type_of(type);
    uint64_t bits;
    if (wire_type == VARINT) {
        if (!read_varint(from, LONGEST_VARINT, &bits)) return false;
    } else {
        const uint8_t *at = from->at;
        unsigned size = wire_type == I32 ? 4 : 8;
        if (!skip(from, size)) return false;
        bits = load_little_endian(at, size);
    }
    *value = scalar(type, bits);
    return true;
}

/* Whether a field can hold a value; a closed enum holds only its own numbers. */
static bool is_known(const struct machine *machine, const struct wanted_field *field, const struct value *value) {
    if (field->type != TYPE_CLOSED_ENUM) return true;
    const struct closed_enum *closed = &machine->layout->closed[field->closed];
    return is_among(value->integer, closed->numbers, closed->count);
}

static struct value range(const struct bytes *bytes) {
    return (struct value){.bytes = bytes->at, .size = (uint32_t)bytes_left(bytes)};
}

static bool read_element(struct machine *machine, const struct wanted_field *field, struct bytes *from) {
    struct value element;
    if (!read_scalar(from, field->type, &element)) return false;
    return !is_known(machine, field, &element) || list_add(machine, &machine->slots[field->slot], element);
}

/* Read a value of a repeated field, or several packed ones. */
static bool read_elements(struct machine *machine, const struct wanted_field *field, uint32_t wire_type,
                          struct bytes *from) {
    struct bytes many;
    if (wire_type != LEN) return read_element(machine, field, from);
    if (!read_len(from, &many)) return false;
    if (field->type == TYPE_BYTES || field->type == TYPE_MESSAGE)
        return list_add(machine, &machine->slots[field->slot], range(&many));
    while (many.at < many.end)
        if (!read_element(machine, field, &many)) return false;
    return true;
}

static bool has_type(const struct wanted_field *field, uint32_t wire_type) {
    uint32_t declared = wire_type_of(field->type);
    return wire_type == declared || (wire_type == LEN && field->is_repeated);
}

/* Clear the other members of a field's oneof. */
static void choose(struct machine *machine, const struct wanted_field *field) {
    struct value *slots = machine->slots;
    if (slots[field->choice].integer == field->number) return;
    memcpy(slots + field->cleared, machine->layout->defaults + field->cleared, field->cleared_count * sizeof *slots);
    slots[field->choice].integer = field->number;
}

/* Record that a field is present. */
static inline void mark(struct machine *machine, const struct wanted_field *field) {
    if (field->choice != NONE) choose(machine, field);
    if (field->presence != NONE) machine->slots[field->presence].integer = 1;
}

/* Read a singular field. A number that a closed enum lacks is an unknown field: it neither clears nor marks anything. */
static bool read_single(struct machine *machine, const struct wanted_field *field, struct bytes *from) {
    struct value value;
    if (!read_scalar(from, field->type, &value)) return false;
    if (!is_known(machine, field, &value)) return true;
    mark(machine, field);
    if (field->slot != NONE) machine->slots[field->slot] = value;
    return true;
}

static bool read_section(struct machine *machine, uint16_t of, struct bytes rest, int depth);

static bool read_field(struct machine *machine, const struct wanted_field *field, uint32_t wire_type,
                       struct bytes *from, int depth) {
    struct bytes value;
    if (field->is_repeated && field->slot != NONE) return read_elements(machine, field, wire_type, from);
    if (wire_type != LEN && wire_type != GROUP) return read_single(machine, field, from);
    mark(machine, field);
    if (!read_value(from, wire_type, &value)) return false;
    if (field->section != NONE) return read_section(machine, field->section, value, depth - 1);
    if (field->slot != NONE) machine->slots[field->slot] = range(&value);
    return true;
}

static bool read_section(struct machine *machine, uint16_t of, struct bytes rest, int depth) {
    if (!depth) return false;
    const struct section *section = &machine->layout->sections[of];
    uint32_t guess = 0;
    while (rest.at < rest.end) {
        uint32_t tag;
        struct bytes unknown;
        if (!read_tag(&rest, &tag)) return false;
        const struct wanted_field *field = find(section, tag >> 3, &guess);
        bool is_read = field != NULL && has_type(field, tag & 7) ? read_field(machine, field, tag & 7, &rest, depth)
                                                                 : read_value(&rest, tag & 7, &unknown);
        if (!is_read) return false;
    }
    return true;
}

bool read_protobuf(struct machine *machine, uint16_t section, const uint8_t *message, size_t size) {
    return read_section(machine, section, (struct bytes){message, message + size}, MOST_SECTIONS_DEEP);
}

bool read_protobuf_pieces(struct machine *machine, uint16_t section, const uint8_t *data, size_t size) {
    struct bytes rest = {data, data + size}, piece;
    uint32_t tag = 0;
    while (rest.at < rest.end)
        if (!read_piece(&rest, &tag, &piece) || !read_section(machine, section, piece, MOST_SECTIONS_DEEP)) return false;
    return true;
}
