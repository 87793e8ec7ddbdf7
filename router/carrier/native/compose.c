#include "compose.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "numbers.h"
#include "utf8.h"

enum { HEADER = 4, FIRST_CAPACITY = 4096 };

bool composer_open(struct composer *composer) {
    memset(composer, 0, sizeof *composer);
    composer->fields.slots = calloc(UINT16_MAX + 1, sizeof *composer->fields.slots);
    composer->fields.cells = malloc(FIRST_CELLS * sizeof *composer->fields.cells);
    composer->fields.cell_capacity = FIRST_CELLS;
    composer->text = malloc(MOST_TEXT);
    composer->message.data = malloc(FIRST_CAPACITY);
    composer->message.capacity = FIRST_CAPACITY;
    return composer->fields.slots && composer->fields.cells && composer->text && composer->message.data;
}

void composer_close(struct composer *composer) {
    free(composer->fields.slots);
    free(composer->fields.cells);
    free(composer->text);
    free(composer->message.data);
}

/* ---- integers ---- */

static int64_t wrapped(uint64_t bits) { return (int64_t)bits; }

static int64_t add(int64_t a, int64_t b) { return wrapped((uint64_t)a + (uint64_t)b); }

static int64_t subtract(int64_t a, int64_t b) { return wrapped((uint64_t)a - (uint64_t)b); }

static int64_t multiply(int64_t a, int64_t b) { return wrapped((uint64_t)a * (uint64_t)b); }

/* Python's `//` and `%`: the quotient is rounded down, the remainder has the divisor's sign. The only quotient beyond 64
 * bits, of the least integer by -1, is none that the compiler lets happen. */
static bool divide(int64_t a, int64_t b, bool is_unsigned, int64_t *quotient, int64_t *remainder) {
    if (!b) return false;
    if (is_unsigned) {
        *quotient = wrapped((uint64_t)a / (uint64_t)b);
        *remainder = wrapped((uint64_t)a % (uint64_t)b);
        return true;
    }
    if (b == -1) {
        *quotient = subtract(0, a);
        *remainder = 0;
        return true;
    }
    *quotient = a / b;
    *remainder = a % b;
    if (*remainder && (*remainder < 0) != (b < 0)) {
        *remainder += b;
        *quotient -= 1;
    }
    return true;
}

static bool wrap(struct value *x, int64_t low, int64_t high) {
    int64_t ignored, inside;
    if (!divide(subtract(x->integer, low), add(subtract(high, low), 1), false, &ignored, &inside)) return false;
    x->integer = add(inside, low);
    return true;
}

static int64_t clamp(int64_t x, int64_t low, int64_t high) { return x < low ? low : x > high ? high : x; }

static bool to_time(struct value *x, int64_t factor, bool is_unsigned) {
    if (is_unsigned && x->integer < 0) return false;
    return !__builtin_mul_overflow(x->integer, factor, &x->integer);
}

/* A time in seconds: the real number that is nearest to the quotient. */
static double seconds(int64_t time) {
    static const int64_t EXACT = (int64_t)1 << 53, NS = 1000000000;
    __extension__ typedef unsigned __int128 wide;
    if (time >= -EXACT && time <= EXACT) return (double)time / (double)NS;
    uint64_t magnitude = time < 0 ? -(uint64_t)time : (uint64_t)time;
    wide dividend = (wide)magnitude << 64, quotient = dividend / (uint64_t)NS;
    if (dividend % (uint64_t)NS) quotient |= 1; /* far below the last bit of the result, where it decides between two */
    double result = ldexp((double)quotient, -64);
    return time < 0 ? -result : result;
}

/* ---- real numbers ---- */

/* As `math` of Python: a number without a result is refused, as is a result beyond all numbers. */
static bool is_result(double result, double of) { return !(isnan(result) && !isnan(of)) && !(isinf(result) && isfinite(of)); }

static double real_clamp(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

static double floor_divide(double a, double b) {
    double remainder = fmod(a, b), quotient = (a - remainder) / b;
    if (remainder != 0 && (b < 0) != (remainder < 0)) quotient -= 1;
    if (quotient == 0) return copysign(0, a / b);
    double whole = floor(quotient);
    return quotient - whole > 0.5 ? whole + 1 : whole;
}

static double modulo(double a, double b) {
    double remainder = fmod(a, b);
    if (remainder == 0) return copysign(0, b);
    return (b < 0) != (remainder < 0) ? remainder + b : remainder;
}

/* Python has one NaN for what these make of any. */
static double angle(double y, double x) { return isnan(x) || isnan(y) ? (double)NAN : atan2(y, x); }

static double length(double x, double y) {
    double result = hypot(x, y);
    return isnan(result) ? (double)NAN : result;
}

/* A whole number has no negative zero. */
static double whole(double number) { return number + 0.0; }

static const double END = 9223372036854775808.0; /* the integers end there */

/* A whole number as an integer between two others; those beyond are `outside`. */
static int64_t to_integer(double number, int64_t low, int64_t high, bool *outside) {
    bool is_low = number < -END || (number < END && (int64_t)number < low);
    bool is_high = !is_low && (number >= END || (int64_t)number > high);
    *outside = is_low || is_high;
    return is_low ? low : is_high ? high : (int64_t)number;
}

/* ---- truth ---- */

#define RELATION(relation, a, b)          \
    switch (relation) {                   \
    case EQUAL: return (a) == (b);        \
    case UNEQUAL: return (a) != (b);      \
    case LESS: return (a) < (b);          \
    case LESS_OR_EQUAL: return (a) <= (b); \
    case MORE: return (a) > (b);          \
    default: return (a) >= (b);           \
    }

static bool compare_signed(enum relation relation, int64_t a, int64_t b) { RELATION(relation, a, b) }

static bool compare_unsigned(enum relation relation, uint64_t a, uint64_t b) { RELATION(relation, a, b) }

static bool compare_reals(enum relation relation, double a, double b) { RELATION(relation, a, b) }

static int64_t order_of_texts(const struct value *a, const struct value *b) {
    uint32_t common = a->size < b->size ? a->size : b->size;
    int order = common ? memcmp(a->bytes, b->bytes, common) : 0;
    return order ? order : (int64_t)a->size - (int64_t)b->size;
}

static bool compare(enum relation relation, enum compared type, const struct value *a, const struct value *b) {
    switch (type) {
    case SIGNED_INTEGERS: return compare_signed(relation, a->integer, b->integer);
    case UNSIGNED_INTEGERS: return compare_unsigned(relation, (uint64_t)a->integer, (uint64_t)b->integer);
    case REALS: return compare_reals(relation, a->real, b->real);
    default: return compare_signed(relation, order_of_texts(a, b), 0);
    }
}

/* ---- text ---- */

static bool join(struct composer *composer, struct value *a, const struct value *b) {
    uint8_t *to = composer->text + composer->text_size;
    if ((size_t)a->size + b->size > MOST_TEXT - composer->text_size) return false;
    memcpy(to, a->bytes, a->size);
    memcpy(to + a->size, b->bytes, b->size);
    *a = (struct value){.bytes = to, .size = a->size + b->size};
    composer->text_size += a->size;
    return true;
}

static bool to_decimal(struct composer *composer, struct value *number, bool is_unsigned) {
    uint8_t digits[20];
    size_t at = sizeof digits;
    bool is_negative = !is_unsigned && number->integer < 0;
    uint64_t rest = is_negative ? -(uint64_t)number->integer : (uint64_t)number->integer;
    do digits[--at] = (uint8_t)('0' + rest % 10);
    while (rest /= 10);
    struct value sign = {.bytes = (const uint8_t *)"-", .size = is_negative};
    struct value text = {.bytes = digits + at, .size = (uint32_t)(sizeof digits - at)};
    *number = sign;
    return join(composer, number, &text);
}

static int64_t characters(const struct value *text) {
    int64_t count = 0;
    for (uint32_t index = 0; index < text->size; index++) count += (text->bytes[index] & 0xC0) != 0x80;
    return count;
}

/* ---- the message ---- */

/* Make room for so many bytes behind the message. */
static bool has_room(struct composed *message, size_t size) {
    if (size <= message->capacity - message->size) return true;
    size_t capacity = message->capacity * 2 + size;
    uint8_t *data = realloc(message->data, capacity);
    if (!data) return false;
    message->data = data;
    message->capacity = capacity;
    return true;
}

/* Append `size` bytes at a multiple of `alignment`, which counts from behind the header. */
static bool put(struct composed *message, const void *bytes, size_t size, size_t alignment) {
    size_t padding = (HEADER - message->size) & (alignment - 1);
    if (!has_room(message, padding + size)) return false;
    memset(message->data + message->size, 0, padding);
    if (size) memcpy(message->data + message->size + padding, bytes, size);
    message->size += padding + size;
    return true;
}

static bool put_integer(struct composed *message, uint64_t bits, uint16_t size) {
    uint8_t bytes[8];
    store_little_endian(bytes, bits, size);
    return put(message, bytes, size, size);
}

static bool put_float(struct composed *message, double number) {
    return fits_float32(number) && put_integer(message, float32_bits(number), sizeof(float));
}

static bool put_double(struct composed *message, double number) {
    return put_integer(message, float64_bits(number), sizeof number);
}

static bool put_text(struct composed *message, const struct value *text) {
    if (text->size && memchr(text->bytes, 0, text->size)) return false;
    return put_integer(message, (uint64_t)text->size + 1, sizeof(uint32_t)) && put(message, text->bytes, text->size, 1) &&
           put_integer(message, 0, 1);
}

/* ---- lists ---- */

static const struct value *element(const struct composer *composer, const struct value *list, int64_t index) {
    if (index >= list->size) return NULL;
    uint32_t at = list->list.first;
    for (; index; index--) at = composer->fields.cells[at].next;
    return &composer->fields.cells[at].value;
}

/* A list that is gone through. What its elements take of cells and text is free again behind each of them. */
struct loop {
    const struct operation *each;
    uint32_t left; /* elements, this one included */
    uint32_t cell;
    const uint8_t *byte; /* of bytes, else NULL */
    uint32_t cell_count;
    size_t text_size;
};

static struct value current(const struct composer *composer, const struct loop *loop) {
    if (loop->byte) return (struct value){.integer = *loop->byte};
    return composer->fields.cells[loop->cell].value;
}

static void advance(struct composer *composer, struct loop *loop) {
    if (loop->byte) loop->byte++;
    else loop->cell = composer->fields.cells[loop->cell].next;
}

/* ---- execution ---- */

/* These end a case: the operation refuses the message unless the condition is true. */
#define WANT(condition)                        \
    if (!(condition)) {                        \
        *at = (uint32_t)(op - operations);     \
        return LOSS_MAPPING_ERROR;             \
    }                                          \
    break

#define REFUSE_NOT_FINITE                      \
    if (!isfinite(top->real)) {                \
        *at = (uint32_t)(op - operations);     \
        return LOSS_NON_FINITE;                \
    }

/* A function of one real number. */
#define FUNCTION(function)                     \
    {                                          \
        double of = top->real;                 \
        top->real = function(of);              \
        WANT(is_result(top->real, of));        \
    }

/* Execute operations. What they leave on the stack is in its second value. */
static int execute(struct composer *composer, const struct operation *operations, uint32_t count, uint32_t *at) {
    struct fields *fields = &composer->fields;
    struct value *slots = fields->slots;
    struct composed *message = &composer->message;
    struct value *top = composer->stack; /* the first one is never used; `top[1]` is what an operation has taken off */
    struct loop loops[MOST_LOOPS + 2], *loop = loops; /* nor is the first of these */
    bool outside;
    int64_t ignored;
    for (const struct operation *op = operations, *end = operations + count; op < end; op++) {
        switch ((enum operation_kind)op->kind) {
        case OP_INTEGER: (++top)->integer = op->integer; break;
        case OP_REAL: (++top)->real = op->real; break;
        case OP_TEXT: *++top = (struct value){.bytes = composer->literals + op->integer, .size = op->size}; break;
        case OP_LOAD: *++top = slots[op->slot]; break;
        case OP_KEEP: slots[op->slot] = *top; break;
        case OP_DROP: top--; break;

        case OP_ADD: top--; top->integer = add(top->integer, top[1].integer); break;
        case OP_SUBTRACT: top--; top->integer = subtract(top->integer, top[1].integer); break;
        case OP_MULTIPLY: top--; top->integer = multiply(top->integer, top[1].integer); break;
        case OP_DIVIDE: top--; WANT(divide(top->integer, top[1].integer, op->flag, &top->integer, &ignored));
        case OP_MODULO: top--; WANT(divide(top->integer, top[1].integer, op->flag, &ignored, &top->integer));
        case OP_NEGATE: top->integer = subtract(0, top->integer); break;
        case OP_ABSOLUTE: if (top->integer < 0) top->integer = subtract(0, top->integer); break;
        case OP_LEAST: top--; if (top[1].integer < top->integer) *top = top[1]; break;
        case OP_GREATEST: top--; if (top[1].integer > top->integer) *top = top[1]; break;
        case OP_CLAMP: top -= 2; top->integer = clamp(top->integer, top[1].integer, top[2].integer); break;
        case OP_FIT: top -= 2; WANT(top->integer >= top[1].integer && top->integer <= top[2].integer);
        case OP_WRAP: top -= 2; WANT(wrap(top, top[1].integer, top[2].integer));
        case OP_TIME: WANT(to_time(top, op->integer, op->flag));

        case OP_REAL_ADD: top--; top->real += top[1].real; break;
        case OP_REAL_SUBTRACT: top--; top->real -= top[1].real; break;
        case OP_REAL_MULTIPLY: top--; top->real *= top[1].real; break;
        case OP_REAL_DIVIDE: top--; top->real /= top[1].real; WANT(top[1].real != 0);
        case OP_REAL_FLOOR_DIVIDE: top--; top->real = floor_divide(top->real, top[1].real); WANT(top[1].real != 0);
        case OP_REAL_MODULO: top--; top->real = modulo(top->real, top[1].real); WANT(top[1].real != 0);
        case OP_REAL_REMAINDER: top--; top->real = fmod(top->real, top[1].real); break;
        case OP_REAL_POWER: {
            double of = (--top)->real;
            top->real = pow(of, top[1].real);
            WANT(is_result(top->real, of));
        }
        case OP_REAL_NEGATE: top->real = -top->real; break;
        case OP_REAL_ABSOLUTE: top->real = fabs(top->real); break;
        case OP_REAL_LEAST: top--; if (top[1].real < top->real) *top = top[1]; break;
        case OP_REAL_GREATEST: top--; if (top[1].real > top->real) *top = top[1]; break;
        case OP_REAL_CLAMP: top -= 2; top->real = real_clamp(top->real, top[1].real, top[2].real); break;
        case OP_ROUND: REFUSE_NOT_FINITE top->real = whole(nearbyint(top->real)); break;
        case OP_TRUNCATE: REFUSE_NOT_FINITE top->real = whole(trunc(top->real)); break;
        case OP_FLOOR: REFUSE_NOT_FINITE top->real = whole(floor(top->real)); break;
        case OP_CEIL: REFUSE_NOT_FINITE top->real = whole(ceil(top->real)); break;
        case OP_SQRT: FUNCTION(sqrt)
        case OP_SIN: FUNCTION(sin)
        case OP_COS: FUNCTION(cos)
        case OP_TAN: FUNCTION(tan)
        case OP_ATAN2: top--; top->real = angle(top->real, top[1].real); break;
        case OP_HYPOT: top--; top->real = length(top->real, top[1].real); break;
        case OP_FLOAT32: WANT(fits_float32(top->real));

        case OP_INTEGER_TO_REAL: top->real = op->flag ? (double)(uint64_t)top->integer : (double)top->integer; break;
        case OP_REAL_CLAMP_TO_INTEGER:
            top -= 2;
            top->integer = to_integer(top->real, top[1].integer, top[2].integer, &outside);
            break;
        case OP_REAL_FIT_TO_INTEGER:
            top -= 2;
            top->integer = to_integer(top->real, top[1].integer, top[2].integer, &outside);
            WANT(!outside);
        case OP_SECONDS: top->real = seconds(top->integer); break;

        case OP_COMPARE: top--; top->integer = compare(op->flag, op->slot, top, top + 1); break;
        case OP_NOT: top->integer = !top->integer; break;
        case OP_JUMP: op += op->slot; break;
        case OP_UNLESS: top--; if (!top[1].integer) op += op->slot; break;
        case OP_AND: if (!top->integer) op += op->slot; else top--; break;
        case OP_OR: if (top->integer) op += op->slot; else top--; break;
        case OP_EITHER: top--; top->integer |= top[1].integer; break;

        case OP_JOIN: top--; WANT(join(composer, top, top + 1));
        case OP_DECIMAL: WANT(to_decimal(composer, top, op->flag));
        case OP_CHARACTERS: top->integer = characters(top); break;
        case OP_SIZE: top->integer = top->size; break;
        case OP_FIT_SIZE: WANT(top->size <= op->integer);
        case OP_UTF8: WANT(is_utf8(top->bytes, top->size));

        case OP_COUNT: (++top)->integer = slots[op->slot].size; break;
        case OP_WANT_COUNT: {
            int64_t size = slots[op->slot].size;
            top -= 2;
            WANT(size >= top[1].integer && size <= top[2].integer);
        }
        case OP_ELEMENT: {
            const struct value *found = element(composer, &slots[op->slot], op->integer);
            if (found) *++top = *found;
            WANT(found);
        }
        case OP_ENTER: top--; WANT(fields_read_element(fields, op->slot, top + 1));
        case OP_EACH:
        case OP_EACH_BYTE: {
            const struct value *list = &slots[op->slot];
            if (!list->size) {
                op += op->size;
                break;
            }
            *++loop = (struct loop){.each = op, .left = list->size, .cell_count = fields->cell_count,
                                    .text_size = composer->text_size};
            if (op->kind == OP_EACH) loop->cell = list->list.first;
            else loop->byte = list->bytes;
            *++top = current(composer, loop);
            break;
        }
        case OP_AGAIN:
            fields->cell_count = loop->cell_count;
            composer->text_size = loop->text_size;
            if (--loop->left) {
                advance(composer, loop);
                *++top = current(composer, loop);
                op = loop->each;
            } else {
                loop--;
            }
            break;

        case OP_KNOWN: WANT(put(message, composer->literals + op->integer, op->size, op->slot));
        case OP_PUT: top--; WANT(put_integer(message, (uint64_t)top[1].integer, op->slot));
        case OP_PUT_FLOAT: top--; WANT(put_float(message, top[1].real));
        case OP_PUT_DOUBLE: top--; WANT(put_double(message, top[1].real));
        case OP_PUT_TEXT: top--; WANT(put_text(message, top + 1));
        case OP_PUT_BYTES: top--; WANT(put(message, top[1].bytes, top[1].size, 1));
        }
    }
    return COMPOSED;
}

/* Execute a program. What it has taken of cells and text is free again. */
static int run(struct composer *composer, const struct operation *operations, uint32_t count, uint32_t *at) {
    uint32_t cell_count = composer->fields.cell_count;
    int outcome = execute(composer, operations, count, at);
    composer->fields.cell_count = cell_count;
    composer->text_size = 0;
    return outcome;
}

int compose(struct composer *composer, const struct operation *operations, uint32_t count, uint32_t *at) {
    static const uint8_t CDR_LE[HEADER] = {0, 1, 0, 0};
    memcpy(composer->message.data, CDR_LE, sizeof CDR_LE);
    composer->message.size = sizeof CDR_LE;
    return run(composer, operations, count, at);
}

int compose_condition(struct composer *composer, const struct operation *operations, uint32_t count, bool *is_true,
                      uint32_t *at) {
    int outcome = run(composer, operations, count, at);
    *is_true = composer->stack[1].integer;
    return outcome;
}
