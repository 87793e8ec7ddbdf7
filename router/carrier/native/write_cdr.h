/* Writes a serialized ROS message in plain CDR (read_cdr.h describes the format). Functions return false if memory runs out
 * or CDR cannot hold a value. They are inline because the machine calls them for each field (evaluate.c). */
#ifndef WRITE_CDR_H
#define WRITE_CDR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "numbers.h"
#include "operations.h"
#include "output.h"

enum { CDR_HEADER = 4, WIDEST = 8 /* bytes of a scalar */ };

/* Pad to a multiple of `alignment`, relative to the end of the header. There is room for WIDEST bytes. */
static inline void align(struct output *output, size_t alignment) {
    memset(output->data + output->size, 0, WIDEST); /* one store instruction, as the size is constant */
    output->size += (CDR_HEADER - output->size) & (alignment - 1);
}

static inline bool put(struct output *output, const void *bytes, size_t size, size_t alignment) {
    if (!has_room(output, WIDEST + size)) return false;
    align(output, alignment);
    if (size) memcpy(output->data + output->size, bytes, size);
    output->size += size;
    return true;
}

/* Append the lowest `size` bytes of an integer. All bytes are stored; the next value overwrites the others. */
static inline bool put_integer(struct output *output, uint64_t bits, uint16_t size) {
    if (!has_room(output, WIDEST + sizeof bits)) return false;
    align(output, size);
    store_little_endian(output->data + output->size, bits, sizeof bits);
    output->size += size;
    return true;
}

static inline bool put_float(struct output *output, double number) {
    return fits_float32(number) && put_integer(output, float32_bits(number), sizeof(float));
}

static inline bool put_double(struct output *output, double number) {
    return put_integer(output, float64_bits(number), sizeof number);
}

static inline bool has_nul(const struct value *text) { return text->size && memchr(text->bytes, 0, text->size); }

static inline bool put_text(struct output *output, const struct value *text) {
    if (has_nul(text)) return false;
    return put_integer(output, (uint64_t)text->size + 1, sizeof(uint32_t)) && put(output, text->bytes, text->size, 1) &&
           put_integer(output, 0, 1);
}

#endif
