/* A buffer for the message that is being written, which grows as needed. */
#ifndef OUTPUT_H
#define OUTPUT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Bytes of a message. Writing a list for each element of another list could exhaust the memory. */
enum { MOST_WRITTEN = 1 << 26 };

struct output {
    uint8_t *data;
    size_t size, capacity;
};

/* Make room for `size` more bytes. Return false if memory runs out or the message gets too long. */
static inline bool has_room(struct output *output, size_t size) {
    if (size <= output->capacity - output->size) return true;
    if (size > MOST_WRITTEN - output->size) return false;
    size_t capacity = output->capacity * 2 + size;
    if (capacity > MOST_WRITTEN) capacity = MOST_WRITTEN;
    uint8_t *data = realloc(output->data, capacity);
    if (!data) return false;
    output->data = data;
    output->capacity = capacity;
    return true;
}

static inline bool append(struct output *output, const void *bytes, size_t size) {
    if (!has_room(output, size)) return false;
    if (size) memcpy(output->data + output->size, bytes, size);
    output->size += size;
    return true;
}

#endif
