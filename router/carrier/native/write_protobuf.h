/* Writes a protobuf message from its first byte to its last. The length of an inner message is known only at its end: one
 * byte is reserved for it, and the inner message is moved if its length needs more. Functions return false if memory
 * runs out. They are inline because the machine calls them for each field (evaluate.c). */
#ifndef WRITE_PROTOBUF_H
#define WRITE_PROTOBUF_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "numbers.h"
#include "operations.h"
#include "output.h"
#include "wire.h"

/* Write a varint; there is room for LONGEST_VARINT bytes. Returns its end. */
static inline uint8_t *store_varint(uint8_t *to, uint64_t value) {
    for (; value > 0x7F; value >>= 7) *to++ = (uint8_t)(value | 0x80);
    *to++ = (uint8_t)value;
    return to;
}

static inline uint64_t to_zigzag(uint64_t bits) { return bits << 1 ^ (bits >> 63 ? UINT64_MAX : 0); }

/* Write the tag of a field. Elements of packed fields have none. */
static inline uint8_t *store_tag(uint8_t *to, uint32_t tag) { return tag ? store_varint(to, tag) : to; }

/* A field that is zero or empty is omitted unless `is_kept`, which is false for fields without presence. */
static inline bool write_varint(struct output *output, uint32_t tag, uint64_t value, bool is_kept) {
    if (!value && !is_kept) return true;
    if (!has_room(output, LONGEST_TAG + LONGEST_VARINT)) return false;
    uint8_t *to = store_tag(output->data + output->size, tag);
    output->size = (size_t)(store_varint(to, value) - output->data);
    return true;
}

static inline bool write_fixed(struct output *output, uint32_t tag, uint64_t bits, unsigned size, bool is_kept) {
    if (!bits && !is_kept) return true;
    if (!has_room(output, LONGEST_TAG + size)) return false;
    uint8_t *to = store_tag(output->data + output->size, tag);
    store_little_endian(to, bits, size);
    output->size = (size_t)(to + size - output->data);
    return true;
}

static inline bool write_bytes(struct output *output, uint32_t tag, const struct value *value, bool is_kept) {
    if (!value->size && !is_kept) return true;
    if (!has_room(output, LONGEST_TAG + LONGEST_SIZE + (size_t)value->size)) return false;
    uint8_t *to = store_varint(store_tag(output->data + output->size, tag), value->size);
    if (value->size) memcpy(to, value->bytes, value->size);
    output->size = (size_t)(to + value->size - output->data);
    return true;
}

/* An inner message or packed elements being written. */
struct opened {
    size_t tag, content; /* offsets in the output */
    bool is_kept;        /* written even if it is empty */
};

static inline bool write_open(struct output *output, uint32_t tag, bool is_kept, struct opened *opened) {
    if (!has_room(output, LONGEST_TAG + 1)) return false;
    uint8_t *to = store_tag(output->data + output->size, tag);
    *opened = (struct opened){output->size, (size_t)(to + 1 - output->data), is_kept};
    output->size = opened->content;
    return true;
}

static inline bool write_close(struct output *output, const struct opened *opened) {
    size_t size = output->size - opened->content;
    if (!size && !opened->is_kept) {
        output->size = opened->tag;
        return true;
    }
    uint8_t length[LONGEST_VARINT];
    size_t more = (size_t)(store_varint(length, size) - length) - 1; /* bytes of the length beyond the reserved one */
    if (!has_room(output, more)) return false;
    uint8_t *content = output->data + opened->content;
    if (more) memmove(content + more, content, size);
    memcpy(content - 1, length, 1 + more);
    output->size += more;
    return true;
}

#endif
