#include "beside.h"

#include <stdlib.h>

#include "numbers.h"
#include "write_protobuf.h"

struct sequence {
    uint64_t last; /* the number of the last message for an endpoint */
};

static uint64_t wrapped(uint64_t number, const struct beside_field *field) {
    unsigned unused = 64u - field->bits;
    return field->is_signed ? (uint64_t)((int64_t)(number << unused) >> unused) : number << unused >> unused;
}

static uint64_t time_in(const struct beside_field *field, int64_t wall) {
    if (field->encoding == BESIDE_DOUBLE) return float64_bits((double)wall * field->scale);
    int64_t time = wall / field->unit;
    return (uint64_t)(field->modulus ? time % field->modulus : time);
}

static void store_padded(uint8_t *to, uint64_t value, unsigned size) {
    for (unsigned index = 0; index < size; index++, value >>= 7) to[index] = (uint8_t)(value | 0x80);
    to[size - 1] &= 0x7F;
}

static void store(uint8_t *to, const struct beside_field *field, uint64_t value) {
    switch (field->encoding) {
    case BESIDE_VARINT: store_padded(to, value, field->size); break;
    case BESIDE_ZIGZAG: store_padded(to, to_zigzag(value), field->size); break;
    default: store_little_endian(to, value, field->size);
    }
}

void beside_fill(const struct beside *beside, const uint8_t *message, int64_t wall) {
    uint8_t *made = (uint8_t *)(uintptr_t)message;
    uint64_t number = ++beside->sequence->last;
    for (uint32_t index = 0; index < beside->count; index++) {
        const struct beside_field *field = &beside->fields[index];
        store(made + field->offset, field, field->value == BESIDE_TIME ? time_in(field, wall) : wrapped(number, field));
    }
}

struct sequence *sequence_open(void) { return calloc(1, sizeof(struct sequence)); }

void sequence_close(struct sequence *sequence) { free(sequence); }
