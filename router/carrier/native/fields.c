#include "fields.h"

#include <stdlib.h>
#include <string.h>

#include "numbers.h"
#include "wire.h"

/* Find a field. Most messages have theirs in order: `guess` is where the next one is then. */
static const struct node_field *find(const struct node *node, uint32_t number, uint32_t *guess) {
    if (*guess < node->count && node->fields[*guess].number == number) return &node->fields[(*guess)++];
    uint32_t low = 0, high = node->count;
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        if (node->fields[middle].number < number) low = middle + 1;
        else high = middle;
    }
    if (low == node->count || node->fields[low].number != number) return NULL;
    *guess = low + 1;
    return &node->fields[low];
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

/* What protobuf makes of the bits of a scalar. */
static struct value scalar(enum field_type type, uint64_t bits) {
    switch (type) {
    case TYPE_BOOL: return (struct value){.integer = bits != 0};
    case TYPE_INT32:
    case TYPE_SFIXED32: return (struct value){.integer = (int32_t)(uint32_t)bits};
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

static bool has_cell(struct fields *fields) {
    if (fields->cell_count < fields->cell_capacity) return true;
    uint32_t capacity = 2 * fields->cell_capacity;
    struct cell *cells = realloc(fields->cells, capacity * sizeof *cells);
    if (!cells) return false;
    fields->cells = cells;
    fields->cell_capacity = capacity;
    return true;
}

static bool add(struct fields *fields, struct value *list, struct value element) {
    if (!has_cell(fields)) return false;
    uint32_t index = fields->cell_count++;
    fields->cells[index].value = element;
    if (list->size++) fields->cells[list->list.last].next = index;
    else list->list.first = index;
    list->list.last = index;
    return true;
}

static struct value range(const struct bytes *bytes) {
    return (struct value){.bytes = bytes->at, .size = (uint32_t)left(bytes)};
}

/* Read a value of a repeated field, or several that are packed. */
static bool read_elements(struct fields *fields, const struct node_field *field, uint32_t wire_type, struct bytes *from) {
    struct value *list = &fields->slots[field->slot], element;
    struct bytes many;
    bool is_scalar = field->type != TYPE_BYTES && field->type != TYPE_MESSAGE;
    if (wire_type != LEN) return read_scalar(from, field->type, &element) && add(fields, list, element);
    if (!read_len(from, &many)) return false;
    if (!is_scalar) return add(fields, list, range(&many));
    while (many.at < many.end)
        if (!read_scalar(&many, field->type, &element) || !add(fields, list, element)) return false;
    return true;
}

static bool has_type(const struct node_field *field, uint32_t wire_type) {
    uint32_t declared = wire_type_of(field->type);
    return wire_type == declared || (wire_type == LEN && field->is_repeated);
}

/* Note that a field is there: it clears the other members of its oneof. */
static void mark(struct fields *fields, const struct node_field *field) {
    if (field->choice != NONE && fields->slots[field->choice].integer != field->number) {
        memcpy(fields->slots + field->cleared, fields->defaults + field->cleared,
               field->cleared_count * sizeof *fields->slots);
        fields->slots[field->choice].integer = field->number;
    }
    if (field->presence != NONE) fields->slots[field->presence].integer = 1;
}

static bool read_node(struct fields *fields, uint16_t of, struct bytes rest, int depth);

static bool read_field(struct fields *fields, const struct node_field *field, uint32_t wire_type, struct bytes *from,
                       int depth) {
    struct bytes value;
    mark(fields, field);
    if (field->is_repeated && field->slot != NONE) return read_elements(fields, field, wire_type, from);
    if (wire_type == LEN) {
        if (!read_len(from, &value)) return false;
        if (field->node != NONE) return read_node(fields, field->node, value, depth - 1);
        if (field->slot != NONE) fields->slots[field->slot] = range(&value);
        return true;
    }
    if (wire_type == GROUP) return read_value(from, wire_type, &value);
    struct value ignored;
    return read_scalar(from, field->type, field->slot != NONE ? &fields->slots[field->slot] : &ignored);
}

static bool read_node(struct fields *fields, uint16_t of, struct bytes rest, int depth) {
    if (!depth) return false;
    const struct node *node = &fields->nodes[of];
    uint32_t guess = 0;
    while (rest.at < rest.end) {
        uint32_t tag;
        struct bytes unknown;
        if (!read_tag(&rest, &tag)) return false;
        const struct node_field *field = find(node, tag >> 3, &guess);
        bool is_read = field != NULL && has_type(field, tag & 7) ? read_field(fields, field, tag & 7, &rest, depth)
                                                                 : read_value(&rest, tag & 7, &unknown);
        if (!is_read) return false;
    }
    return true;
}

bool fields_read(struct fields *fields, uint16_t node, const uint8_t *message, size_t size) {
    return read_node(fields, node, (struct bytes){message, message + size}, MOST_NODES_DEEP);
}

bool fields_read_element(struct fields *fields, uint16_t node, const struct value *element) {
    const struct node *of = &fields->nodes[node];
    memcpy(fields->slots + of->first_slot, fields->defaults + of->first_slot, of->slot_count * sizeof *fields->slots);
    return fields_read(fields, node, element->bytes, element->size);
}
