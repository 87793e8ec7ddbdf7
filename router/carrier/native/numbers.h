/* Numbers as they stand in messages: protobuf and CDR have them little-endian, floats as IEEE 754 has them. */
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

/* Whether a number is finite as a float32, or not finite anyway. */
static inline bool fits_float32(double number) {
    static const double END = 3.4028235677973366e38; /* the smallest magnitude that does not round to a finite float32 */
    return !isfinite(number) || fabs(number) < END;
}

#endif
