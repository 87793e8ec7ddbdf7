/* Arithmetic and comparison as docs/reference/table.md specifies them: integers of 64 bits, signed or unsigned, without
 * overflow; real numbers in double. Functions that return false have no result. */
#ifndef ARITHMETIC_H
#define ARITHMETIC_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "operations.h"

/* ---- integers ---- */

/* Holds every signed and unsigned 64-bit integer, and their sums and differences. */
__extension__ typedef __int128 wide;

/* An operand; `sign` is its flag. Without any flag all operands are int64, for which most operations have a fast path. */
static inline wide widened(const struct value *operand, unsigned flags, enum sign sign) {
    return flags & sign ? (wide)operand->bits : (wide)operand->integer;
}

static inline bool narrow(struct value *result, wide exact, unsigned flags) {
    result->bits = (uint64_t)exact;
    return flags & RESULT_UNSIGNED ? exact >= 0 && exact <= UINT64_MAX : exact >= INT64_MIN && exact <= INT64_MAX;
}

static inline bool checked_add(struct value *a, const struct value *b, unsigned flags) {
    if (!flags) return !__builtin_add_overflow(a->integer, b->integer, &a->integer);
    return narrow(a, widened(a, flags, FIRST_UNSIGNED) + widened(b, flags, SECOND_UNSIGNED), flags);
}

static inline bool checked_subtract(struct value *a, const struct value *b, unsigned flags) {
    if (!flags) return !__builtin_sub_overflow(a->integer, b->integer, &a->integer);
    return narrow(a, widened(a, flags, FIRST_UNSIGNED) - widened(b, flags, SECOND_UNSIGNED), flags);
}

static inline bool checked_multiply(struct value *a, const struct value *b, unsigned flags) {
    if (!flags) return !__builtin_mul_overflow(a->integer, b->integer, &a->integer);
    wide product;
    if (__builtin_mul_overflow(widened(a, flags, FIRST_UNSIGNED), widened(b, flags, SECOND_UNSIGNED), &product)) return false;
    return narrow(a, product, flags);
}

static inline bool checked_negate(struct value *a, unsigned flags) {
    return narrow(a, -widened(a, flags, FIRST_UNSIGNED), flags);
}

/* The quotient is rounded down, so that the remainder has the divisor's sign. */
static inline bool divide(struct value *a, const struct value *b, unsigned flags) {
    if (!flags && b->integer > 0) {
        a->integer = a->integer / b->integer - (a->integer % b->integer < 0);
        return true;
    }
    wide dividend = widened(a, flags, FIRST_UNSIGNED), divisor = widened(b, flags, SECOND_UNSIGNED);
    if (!divisor) return false;
    wide quotient = dividend / divisor;
    if (dividend % divisor && (dividend < 0) != (divisor < 0)) quotient--;
    return narrow(a, quotient, flags);
}

static inline wide remainder_of(wide dividend, wide divisor) {
    wide remainder = dividend % divisor;
    return remainder && (remainder < 0) != (divisor < 0) ? remainder + divisor : remainder;
}

static inline bool modulo(struct value *a, const struct value *b, unsigned flags) {
    if (!flags && b->integer > 0) {
        int64_t remainder = a->integer % b->integer;
        a->integer = remainder < 0 ? remainder + b->integer : remainder;
        return true;
    }
    wide dividend = widened(a, flags, FIRST_UNSIGNED), divisor = widened(b, flags, SECOND_UNSIGNED);
    return divisor && narrow(a, remainder_of(dividend, divisor), flags);
}

/* These functions serve operations whose result is one of the operands, so its bits need no conversion. */
static inline bool is_less(const struct value *a, const struct value *b, unsigned flags) {
    if (!flags) return a->integer < b->integer;
    return widened(a, flags, FIRST_UNSIGNED) < widened(b, flags, SECOND_UNSIGNED);
}

static inline bool is_below(const struct value bounds[3], unsigned flags) {
    if (!flags) return bounds[0].integer < bounds[1].integer;
    return widened(&bounds[0], flags, FIRST_UNSIGNED) < widened(&bounds[1], flags, SECOND_UNSIGNED);
}

static inline bool is_above(const struct value bounds[3], unsigned flags) {
    if (!flags) return bounds[0].integer > bounds[2].integer;
    return widened(&bounds[0], flags, FIRST_UNSIGNED) > widened(&bounds[2], flags, THIRD_UNSIGNED);
}

static inline bool wrap(struct value x[3], unsigned flags) {
    wide low = widened(&x[1], flags, SECOND_UNSIGNED), high = widened(&x[2], flags, THIRD_UNSIGNED);
    if (low > high) return false;
    return narrow(x, low + remainder_of(widened(x, flags, FIRST_UNSIGNED) - low, high - low + 1), flags);
}

/* ---- real numbers ---- */

static inline double real_clamp(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

/* The next two are for divisors other than zero. */
static inline double real_modulo(double a, double b) {
    double remainder = fmod(a, b);
    if (remainder == 0) return copysign(0, b);
    return (b < 0) != (remainder < 0) ? remainder + b : remainder;
}

/* `(a - remainder) / b` is a whole number or next to one. */
static inline double real_floor_divide(double a, double b) {
    double remainder = fmod(a, b), quotient = (a - remainder) / b;
    if (remainder != 0 && (b < 0) != (remainder < 0)) quotient -= 1;
    if (quotient == 0) return copysign(0, a / b);
    double whole = floor(quotient);
    return quotient - whole > 0.5 ? whole + 1 : whole;
}

/* Whether a function of one number has a result, which is finite if the number is. */
static inline bool is_result(double result, double of) {
    return !(isnan(result) && !isnan(of)) && !(isinf(result) && isfinite(of));
}

static inline bool power(double *base, double exponent) {
    double of = *base;
    *base = pow(of, exponent);
    return !(isnan(*base) && !isnan(of) && !isnan(exponent)) && !(isinf(*base) && isfinite(of) && isfinite(exponent));
}

static inline double angle(double y, double x) { return isnan(x) || isnan(y) ? (double)NAN : atan2(y, x); }

static inline double length(double x, double y) {
    double result = hypot(x, y);
    return isnan(result) ? (double)NAN : result;
}

/* Convert a whole number to an integer. */
static inline bool to_integer(struct value *whole) {
    static const double END = 0x1p63; /* int64 goes from -2^63 to just below it */
    if (!(whole->real >= -END && whole->real < END)) return false;
    whole->integer = (int64_t)whole->real;
    return true;
}

/* ---- comparison ---- */

enum order { BEFORE = -1, SAME, AFTER, UNORDERED };

static inline enum order order_of_mixed(int64_t a, uint64_t b) {
    if (a < 0 || (uint64_t)a < b) return BEFORE;
    return (uint64_t)a == b ? SAME : AFTER;
}

/* Compare an integer and a real number. `wholes` compares the integer and `whole`, the whole part of the real number. */
static inline enum order order_of_rest(enum order wholes, double real, double whole) {
    if (wholes != SAME || real == whole) return wholes;
    return real > whole ? BEFORE : AFTER;
}

/* No integer is rounded to compare it: 2^53 + 1 is more than 2^53. */
static inline enum order order_with_real(int64_t a, double b) {
    if (isnan(b)) return UNORDERED;
    if (b >= 0x1p63) return BEFORE;
    if (b < -0x1p63) return AFTER;
    int64_t whole = (int64_t)b;
    return order_of_rest(a < whole ? BEFORE : a == whole ? SAME : AFTER, b, (double)whole);
}

static inline enum order order_of_unsigned_with_real(uint64_t a, double b) {
    if (isnan(b)) return UNORDERED;
    if (b >= 0x1p64) return BEFORE;
    if (b < 0) return AFTER;
    uint64_t whole = (uint64_t)b;
    return order_of_rest(a < whole ? BEFORE : a == whole ? SAME : AFTER, b, (double)whole);
}

static inline enum order order_of_texts(const struct value *a, const struct value *b) {
    uint32_t common = a->size < b->size ? a->size : b->size;
    int order = common ? memcmp(a->bytes, b->bytes, common) : 0;
    if (!order) return a->size < b->size ? BEFORE : a->size == b->size ? SAME : AFTER;
    return order < 0 ? BEFORE : AFTER;
}

#define RELATION(relation, a, b)           \
    switch (relation) {                    \
    case EQUAL: return (a) == (b);         \
    case UNEQUAL: return (a) != (b);       \
    case LESS: return (a) < (b);           \
    case LESS_OR_EQUAL: return (a) <= (b); \
    case GREATER: return (a) > (b);        \
    default: return (a) >= (b);            \
    }

static inline bool compare_signed(enum relation relation, int64_t a, int64_t b) { RELATION(relation, a, b) }

static inline bool compare_unsigned(enum relation relation, uint64_t a, uint64_t b) { RELATION(relation, a, b) }

static inline bool compare_reals(enum relation relation, double a, double b) { RELATION(relation, a, b) }

#undef RELATION

static inline bool is_ordered(enum relation relation, enum order order) {
    return order == UNORDERED ? relation == UNEQUAL : compare_signed(relation, order, SAME);
}

static inline bool compare(enum relation relation, enum compared types, const struct value *a, const struct value *b) {
    switch (types) {
    case SIGNED_INTEGERS: return compare_signed(relation, a->integer, b->integer);
    case UNSIGNED_INTEGERS: return compare_unsigned(relation, a->bits, b->bits);
    case SIGNED_WITH_UNSIGNED: return is_ordered(relation, order_of_mixed(a->integer, b->bits));
    case SIGNED_WITH_REAL: return is_ordered(relation, order_with_real(a->integer, b->real));
    case UNSIGNED_WITH_REAL: return is_ordered(relation, order_of_unsigned_with_real(a->bits, b->real));
    case REALS: return compare_reals(relation, a->real, b->real);
    default: return is_ordered(relation, order_of_texts(a, b));
    }
}

#endif
