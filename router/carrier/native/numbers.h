/* The encoding of numbers in protobuf and CDR: little-endian, floats as in IEEE 754. */
#ifndef NUMBERS_H
#define NUMBERS_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

static inline uint64_t load_little_endian(const uint8_t *from, unsigned size) {
    uint64_t bits = 0;
    for (unsigned index = 0; index < size; index++) bits |= (uint64_t)from[index] << (8 * index);
    return bits;
}

static inline void store_little_endian(uint8_t *to, uint64_t bits, unsigned size) {
    for (unsigned index = 0; index < size; index++) to[index] = (uint8_t)(bits >> (8 * index));
}

/* Whether a number is one of `count` ascending int32 at `numbers`, which need not be aligned. */
static inline bool is_among(int64_t number, const void *numbers, uint32_t count) {
    uint32_t low = 0, high = count;
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        int32_t found;
        memcpy(&found, (const uint8_t *)numbers + (size_t)middle * sizeof found, sizeof found);
        if (found == number) return true;
        if (found < number) low = middle + 1;
        else high = middle;
    }
    return false;
}

static inline double of_float32(uint64_t bits) {
    uint32_t low = (uint32_t)bits;
    float number;
    memcpy(&number, &low, sizeof number);
    return (double)number;
}

static inline double of_float64(uint64_t bits) {
    double number;
    memcpy(&number, &bits, sizeof number);
    return number;
}

static inline uint64_t float32_bits(double number) {
    float narrow = (float)number;
    uint32_t bits;
    memcpy(&bits, &narrow, sizeof bits);
    return bits;
}

static inline uint64_t float64_bits(double number) {
    uint64_t bits;
    memcpy(&bits, &number, sizeof bits);
    return bits;
}

/* Whether a number stays finite as a float32; true for infinity and NaN. */
static inline bool fits_float32(double number) {
    static const double END = 3.4028235677973366e38; /* the smallest magnitude that rounds to infinity */
    return !isfinite(number) || fabs(number) < END;
}

#endif
