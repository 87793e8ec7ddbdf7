/* A field of the envelope names the message, and another one has its bytes; without it, the message is empty. Of several such
 * fields, the last ones count, as in protobuf. The whole name has to be known. */
#include "find_case.h"

#include <string.h>

static int compare(struct bytes text, const struct wire_name *name) {
    size_t size = bytes_left(&text), shorter = size < name->size ? size : name->size;
    int order = shorter ? memcmp(text.at, name->text, shorter) : 0;
    return order ? order : (size > name->size) - (size < name->size);
}

/* Return the number of the case with this name, or 0. */
static uint32_t number_of(const struct wire_schema *schema, struct bytes text) {
    uint32_t low = 0, high = schema->name_count;
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        int order = compare(text, &schema->names[middle]);
        if (order == 0) return middle + 1;
        if (order > 0) low = middle + 1;
        else high = middle;
    }
    return 0;
}

/* One of the two fields: the last value, and how many there are. */
struct found {
    uint32_t number;
    struct bytes value;
    uint32_t count;
    bool is_mistyped; /* there is one with another wire type */
};

static void take(struct found *found, uint32_t tag, struct bytes value) {
    if (tag >> 3 != found->number) return;
    if ((tag & 7) != LEN) {
        found->is_mistyped = true;
        return;
    }
    found->value = value;
    found->count++;
}

static int mistyped(struct envelope *envelope, const struct found *found) {
    envelope->case_number = found->number;
    return MALFORMED;
}

int find_by_name(const struct wire_schema *schema, const uint8_t *frame, struct envelope *envelope) {
    struct bytes rest = {frame, frame + envelope->size};
    struct found name = {.number = schema->name_field}, payload = {.number = schema->payload_field};
    if (envelope->size == 0 && !envelope->is_repaired) return EMPTY;
    payload.value = (struct bytes){frame, frame};
    while (rest.at < rest.end) {
        uint32_t tag;
        struct bytes value;
        if (!read_tag(&rest, &tag) || !read_value(&rest, tag & 7, &value)) return MALFORMED;
        take(&name, tag, value);
        take(&payload, tag, value);
    }
    if (bytes_left(&name.value) == 0) return name.is_mistyped ? mistyped(envelope, &name) : NO_PAYLOAD;
    uint32_t number = number_of(schema, name.value);
    if (number == 0) return UNKNOWN_CASE;
    if (bytes_left(&payload.value) == 0 && payload.is_mistyped) return mistyped(envelope, &payload);
    uint16_t type = schema->names[number - 1].type;
    if (type != 0 && !is_well_formed(schema, &schema->types[type], payload.value)) return MALFORMED;
    envelope->case_number = number;
    envelope->start = (uint32_t)(payload.value.at - frame);
    envelope->length = (uint32_t)bytes_left(&payload.value);
    envelope->others = (name.count > payload.count ? name.count : payload.count) - 1;
    envelope->is_single = true;
    return -1;
}
