/* Evaluates the expressions of a topic, and writes its message as CDR: by a program that router/compiler/lowering
 * makes of the same plan as the generated Python, with the same result to the last bit.
 *
 * Operations take their operands from a stack of values, and leave the result there. The compiler knows the type of each
 * value and the range of each integer: none leaves 64 bits, so additions need no check here. */
#ifndef COMPOSE_H
#define COMPOSE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "events.h"
#include "fields.h"

enum {
    MOST_STACKED = 256,  /* values at a time, and one that is not used */
    MOST_LOOPS = 8,      /* lists in lists, and one more to check texts */
    MOST_TEXT = 1 << 20  /* bytes of text that a program puts together: the compiler has added them up */
};

enum operation_kind {
    /* Values: */
    OP_INTEGER, /* `integer` */
    OP_REAL,    /* `real` */
    OP_TEXT,    /* `size` bytes of the literals, from `integer` */
    OP_LOAD,    /* of `slot` */
    OP_KEEP,    /* to `slot`; it stays on the stack */
    OP_DROP,
    /* Integers, exact modulo 2^64: */
    OP_ADD,
    OP_SUBTRACT,
    OP_MULTIPLY,
    OP_DIVIDE, /* downwards; `flag`: unsigned. By zero: refused */
    OP_MODULO, /* with the divisor's sign; likewise */
    OP_NEGATE,
    OP_ABSOLUTE,
    OP_LEAST, /* of two */
    OP_GREATEST,
    OP_CLAMP, /* the first of three between the others */
    OP_FIT,   /* likewise, but refuses what is outside */
    OP_WRAP,
    OP_TIME, /* times `integer`, in ns: refused beyond 64 bits; `flag`: of an unsigned one */
    /* Real numbers: */
    OP_REAL_ADD,
    OP_REAL_SUBTRACT,
    OP_REAL_MULTIPLY,
    OP_REAL_DIVIDE, /* by zero: refused */
    OP_REAL_FLOOR_DIVIDE,
    OP_REAL_MODULO,
    OP_REAL_REMAINDER, /* with the dividend's sign */
    OP_REAL_POWER,
    OP_REAL_NEGATE,
    OP_REAL_ABSOLUTE,
    OP_REAL_LEAST,
    OP_REAL_GREATEST,
    OP_REAL_CLAMP,
    OP_ROUND, /* to the even one of two; these four refuse what is not finite */
    OP_TRUNCATE,
    OP_FLOOR,
    OP_CEIL,
    OP_SQRT, /* this and the next refuse numbers without a result */
    OP_SIN,
    OP_COS,
    OP_TAN,
    OP_ATAN2,
    OP_HYPOT,
    OP_FLOAT32, /* refuses a finite number that is infinite as a float32 */
    /* From one to the other: */
    OP_INTEGER_TO_REAL, /* `flag`: of an unsigned one */
    OP_REAL_CLAMP_TO_INTEGER, /* a whole number, between two integers */
    OP_REAL_FIT_TO_INTEGER,
    OP_SECONDS, /* of a time */
    /* Truth: */
    OP_COMPARE, /* by `flag`, an enum relation, and `slot`, an enum compared */
    OP_NOT,
    OP_JUMP,    /* over `slot` operations */
    OP_UNLESS,  /* likewise, if it is false */
    OP_AND,     /* likewise, and leave it there; else drop it */
    OP_OR,      /* if it is true */
    OP_EITHER,  /* of two, both evaluated */
    /* Text and bytes: */
    OP_JOIN,
    OP_DECIMAL, /* an integer as text */
    OP_CHARACTERS,
    OP_SIZE,     /* in bytes */
    OP_FIT_SIZE, /* refuses more than `integer` bytes */
    OP_UTF8,     /* refuses what is none */
    /* Lists: */
    OP_COUNT,      /* of the list in `slot` */
    OP_WANT_COUNT, /* refuses a count outside of the two integers on the stack, which it leaves out */
    OP_ELEMENT,    /* element `integer` of the list in `slot`; refused if there is none */
    OP_ENTER,      /* read the message on the stack into node `slot` */
    OP_EACH,       /* the next `size` operations, the last of which is its OP_AGAIN, for each element of the list in `slot`,
                      which comes on the stack */
    OP_EACH_BYTE,
    OP_AGAIN,
    /* The message: */
    OP_KNOWN,  /* `size` bytes of the literals, from `integer`, aligned to `slot` */
    OP_PUT,    /* the lowest `slot` bytes of an integer, aligned to their number */
    OP_PUT_FLOAT, /* refuses what is too large */
    OP_PUT_DOUBLE,
    OP_PUT_TEXT, /* refuses a NUL in it */
    OP_PUT_BYTES /* without their number */
};

enum relation { EQUAL, UNEQUAL, LESS, LESS_OR_EQUAL, MORE, MORE_OR_EQUAL };
enum compared { SIGNED_INTEGERS, UNSIGNED_INTEGERS, REALS, TEXTS };

struct operation {
    uint8_t kind; /* enum operation_kind */
    uint8_t flag;
    uint16_t slot;
    uint32_t size;
    union {
        int64_t integer;
        double real;
        uint64_t bits;
    };
};

/* What is composed, at the end of `data`: CDR bytes with their header. Belongs to the caller; grows as necessary. */
struct composed {
    uint8_t *data;
    size_t size, capacity;
};

struct composer {
    struct fields fields;
    const uint8_t *literals;
    struct composed message;
    uint8_t *text; /* MOST_TEXT */
    size_t text_size;
    struct value stack[MOST_STACKED];
};

enum { COMPOSED = -1 };

/* Allocate what a composer needs. Return false for lack of memory. To be closed in either case. */
bool composer_open(struct composer *composer);
void composer_close(struct composer *composer);

/* Have `message` hold the message that a program makes of the slots. Return COMPOSED, or an enum loss with the message
 * void; `at` is then the operation that refused. */
int compose(struct composer *composer, const struct operation *operations, uint32_t count, uint32_t *at);

/* Evaluate a condition into `is_true`. Returns as `compose`. */
int compose_condition(struct composer *composer, const struct operation *operations, uint32_t count, bool *is_true,
                      uint32_t *at);

#endif
