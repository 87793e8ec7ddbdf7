/* Writes a serialized ROS message, in plain CDR (read_cdr.h has the format). Each returns false for lack of memory, or for
 * a value that CDR cannot hold. Small, and inline in what runs programs. */
#ifndef WRITE_CDR_H
#define WRITE_CDR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "numbers.h"
#include "operations.h"
#include "output.h"

enum { CDR_HEADER = 4 };

/* Append `size` bytes at a multiple of `alignment`, which counts from behind the header. */
static inline bool put(struct output *output, const void *bytes, size_t size, size_t alignment) {
    size_t padding = (CDR_HEADER - output->size) & (alignment - 1);
    if (!has_room(output, padding + size)) return false;
    memset(output->data + output->size, 0, padding);
    if (size) memcpy(output->data + output->size + padding, bytes, size);
    output->size += padding + size;
    return true;
}

static inline bool put_integer(struct output *output, uint64_t bits, uint16_t size) {
    uint8_t bytes[8];
    store_little_endian(bytes, bits, size);
    return put(output, bytes, size, size);
}

static inline bool put_float(struct output *output, double number) {
    return fits_float32(number) && put_integer(output, float32_bits(number), sizeof(float));
}

static inline bool put_double(struct output *output, double number) {
    return put_integer(output, float64_bits(number), sizeof number);
}

static inline bool put_text(struct output *output, const struct value *text) {
    if (text->size && memchr(text->bytes, 0, text->size)) return false;
    return put_integer(output, (uint64_t)text->size + 1, sizeof(uint32_t)) && put(output, text->bytes, text->size, 1) &&
           put_integer(output, 0, 1);
}

#endif
