/* The one program format, for all directions: a layout says what a reader puts into slots (read_protobuf.h, read_cdr.h),
 * operations compute with them on a stack (evaluate.h), and the last ones write a message (write_cdr.h, write_protobuf.h).
 * router/compiler/lowering makes programs of checked expressions.
 *
 * The compiler knows the type of each value and the range of each integer. An integer has 64 bits, signed or unsigned;
 * where a result may not fit, an operation checks it. An operation that has no result refuses the message. */
#ifndef OPERATIONS_H
#define OPERATIONS_H

#include <stdint.h>

enum {
    MOST_STACKED = 256,  /* values at a time, and one that is not used */
    MOST_LOOPS = 8,      /* loops in loops */
    MOST_OPEN = 32,      /* payloads in payloads, while one is written */
    MOST_TEXT = 1 << 20  /* bytes of text that a program puts together: the compiler has added them up */
};
enum { NONE = UINT16_MAX }; /* no such slot, node or enum */

/* ---- values ---- */

/* Elements of a list in cells; of none, `first` means nothing. */
struct list {
    uint32_t first, last;
};

/* An integer or bool, a real number, text or bytes, a message as it was received, or a list. */
struct value {
    union {
        int64_t integer;
        double real;
        const uint8_t *bytes;
        struct list list;
        uint64_t bits;
    };
    uint32_t size; /* bytes, or elements of a list */
    uint32_t reserved;
};

struct cell {
    struct value value;
    uint32_t next, reserved;
};

/* Scalars as CDR has them, and how a list is stored: as `size` of these in a row at `bytes`, or in cells. */
enum scalar {
    SCALAR_BOOL,
    SCALAR_INT8,
    SCALAR_UINT8,
    SCALAR_INT16,
    SCALAR_UINT16,
    SCALAR_INT32,
    SCALAR_UINT32,
    SCALAR_INT64,
    SCALAR_UINT64,
    SCALAR_FLOAT32,
    SCALAR_FLOAT64,
    IN_CELLS
};

/* ---- operations ---- */

enum operation_kind {
    /* Values: */
    OP_INTEGER, /* `integer` */
    OP_REAL,    /* `real` */
    OP_TEXT,    /* `size` bytes of the literals, from `integer` */
    OP_LOAD,    /* of `slot` */
    OP_KEEP,    /* to `slot`; it stays on the stack */
    OP_DROP,
    /* Integers. `flag`: enum sign, of the operands and of the result. The plain ones are exact modulo 2^64 and for
     * results that fit; the CHECKED ones refuse a result that does not: */
    OP_ADD,
    OP_SUBTRACT,
    OP_MULTIPLY,
    OP_CHECKED_ADD,
    OP_CHECKED_SUBTRACT,
    OP_CHECKED_MULTIPLY,
    OP_CHECKED_NEGATE,
    OP_NEGATE,
    OP_ABSOLUTE, /* of a signed one: at most 2^63, as unsigned */
    OP_DIVIDE,   /* downwards; by zero, or a result that does not fit: refused */
    OP_MODULO,   /* with the divisor's sign; likewise */
    OP_LEAST,    /* of two */
    OP_GREATEST,
    OP_CLAMP, /* the first of three between the others */
    OP_FIT,   /* likewise, but refuses what is outside */
    OP_WRAP,  /* likewise, but counts on from the low bound; refused if that is above the high one */
    /* Real numbers: */
    OP_REAL_ADD,
    OP_REAL_SUBTRACT,
    OP_REAL_MULTIPLY,
    OP_REAL_DIVIDE, /* by zero: refused, as the next two */
    OP_REAL_FLOOR_DIVIDE,
    OP_REAL_MODULO,
    OP_REAL_POWER,
    OP_REAL_NEGATE,
    OP_REAL_ABSOLUTE,
    OP_REAL_LEAST,
    OP_REAL_GREATEST,
    OP_REAL_CLAMP,
    OP_SQRT, /* these refuse numbers without a result, and what is finite but for its result */
    OP_SIN,
    OP_COS,
    OP_TAN,
    OP_ATAN2,
    OP_HYPOT,
    OP_FLOAT32, /* refuses a finite number that is infinite as a float32 */
    /* From one to the other: */
    OP_INTEGER_TO_REAL, /* `flag`: of an unsigned one */
    OP_ROUND, /* to the even one of two; these four give a signed integer, and refuse a number that has none: as
                 LOSS_NON_FINITE if it is NaN or infinite */
    OP_TRUNCATE,
    OP_FLOOR,
    OP_CEIL,
    /* Truth: */
    OP_COMPARE, /* by `flag`, an enum relation, and `slot`, an enum compared */
    OP_NOT,
    OP_JUMP,   /* over `size` operations */
    OP_UNLESS, /* likewise, if it is false */
    OP_AND,    /* likewise, and leave it there; else drop it */
    OP_OR,     /* if it is true */
    OP_EITHER, /* of two, both evaluated */
    OP_WANT,   /* take it off, and refuse what is false */
    /* Text and bytes: */
    OP_JOIN,
    OP_DECIMAL,    /* an integer as text; `flag`: an unsigned one */
    OP_DIGITS,     /* a real number as text with `slot` decimals: "nan", "inf" and "-inf" where it is not finite */
    OP_CHARACTERS, /* how many there are in UTF-8 */
    OP_SIZE,       /* in bytes; of a list its elements */
    OP_FIT_SIZE,   /* refuses more than `integer` bytes */
    OP_UTF8,       /* refuses what is none */
    OP_OCTETS,     /* a list (`flag`: how it is stored) of integers as bytes; refuses those outside of 0 to 255 */
    OP_MEMBER,     /* refuses an integer that is none of `size` int32 of the literals, from `integer`, ascending */
    /* Lists. `flag`: how they are stored, an enum scalar: */
    OP_ELEMENT, /* element `integer` of a list; refused if there is none */
    OP_ENTER,   /* read the message on the stack into node `slot` */
    OP_REPEAT,  /* the next `size` operations, the last of which is its OP_AGAIN, as often as the integer on the stack
                   says. `flag`: cells and text that they take are kept; else they are free again behind each time */
    OP_AGAIN,
    OP_NEXT,   /* take the first element off the list in `slot` */
    OP_LIST,   /* the `size` values on the stack as a list in cells */
    OP_UNPACK, /* a list that is stored otherwise, in cells */
    OP_APPEND, /* to the list in cells in `slot` */
    /* A message, from its first byte on; of CDR that is its header, the first of its known bytes: */
    OP_KNOWN, /* `size` bytes of the literals, from `integer`, aligned to `slot`; in protobuf, 1 */
    /* A message in CDR. Alignment counts from behind the header: */
    OP_PUT,   /* the lowest `slot` bytes of an integer, aligned to their number */
    OP_PUT_FLOAT, /* refuses what is too large */
    OP_PUT_DOUBLE,
    OP_PUT_TEXT,  /* refuses a NUL in it */
    OP_PUT_BYTES, /* without their number */
    /* A message in protobuf. `size`: the tag, field number << 3 | wire type, or 0 for none, as of a packed element. Zero
     * and the empty string are written if `flag` is 1: */
    OP_OPEN, /* a message, or packed elements: what follows up to its OP_CLOSE has tag and length in front. `flag` 0: left
                out if it is empty, as packed elements are */
    OP_CLOSE,
    OP_WRITE_VARINT,
    OP_WRITE_ZIGZAG,
    OP_WRITE_FIXED32,
    OP_WRITE_FIXED64,
    OP_WRITE_FLOAT, /* refuses what is too large */
    OP_WRITE_DOUBLE,
    OP_WRITE_BYTES /* and text */
};

/* Which operands of an operation with integers are unsigned, and whether its result is. */
enum sign { FIRST_UNSIGNED = 1, SECOND_UNSIGNED = 2, THIRD_UNSIGNED = 4, RESULT_UNSIGNED = 8 };

enum relation { EQUAL, UNEQUAL, LESS, LESS_OR_EQUAL, MORE, MORE_OR_EQUAL };

/* What is compared with what, exactly: the first of two is the left operand. */
enum compared {
    SIGNED_INTEGERS,
    UNSIGNED_INTEGERS,
    SIGNED_WITH_UNSIGNED,
    SIGNED_WITH_REAL,
    UNSIGNED_WITH_REAL,
    REALS,
    TEXTS
};

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

/* Operations, in order. */
struct code {
    const struct operation *operations;
    uint32_t count, reserved;
};

/* ---- what is read ---- */

enum field_type {
    TYPE_BOOL,
    TYPE_INT32, /* open enums as well */
    TYPE_INT64, /* uint64 as well: the same bits */
    TYPE_UINT32,
    TYPE_SINT32,
    TYPE_SINT64,
    TYPE_FIXED32,
    TYPE_SFIXED32,
    TYPE_FIXED64, /* and sfixed64 */
    TYPE_FLOAT,
    TYPE_DOUBLE,
    TYPE_BYTES, /* and string */
    TYPE_MESSAGE,
    TYPE_GROUP,      /* never wanted, but it may be a member of a oneof */
    TYPE_CLOSED_ENUM /* a number that it does not have is an unknown field */
};

/* A wanted field of a protobuf message, or a member of its oneof. */
struct node_field {
    uint32_t number;
    uint8_t type; /* enum field_type */
    uint8_t is_repeated;
    uint16_t slot;     /* of its value or list, or NONE */
    uint16_t presence; /* slot that becomes 1 when it is there, or NONE */
    uint16_t node;     /* of a message that is not repeated, or NONE */
    uint16_t choice;   /* slot with the number of the oneof's member that is there, or NONE */
    uint16_t cleared, cleared_count; /* slots of the oneof's members */
    uint16_t closed;   /* of the layout's closed enums, or NONE */
};

struct closed_enum {
    const int32_t *numbers; /* ascending */
    uint32_t count, reserved;
};

enum read_kind {
    READ_SCALAR,   /* `type`, into `slot` */
    READ_SKIP,     /* `count` scalars of `size` bytes, which is also their alignment */
    READ_ARRAY,    /* `count` scalars of `size` bytes: a list of them, into `slot`, which is never NONE */
    READ_SEQUENCE, /* likewise, but a length says how many; NONE: skipped */
    READ_TEXT,     /* a length, which counts the final NUL, and the bytes; into `slot` without the NUL, or NONE */
    READ_EACH,     /* what follows, up to its READ_AGAIN, `count` times. `slot`: a list in cells that gets each beginning,
                      with all bytes up to the end of the message, or NONE */
    READ_EACH_SEQUENCE, /* likewise, but a length says how often */
    READ_AGAIN,
    READ_TEXTS /* as READ_TEXT, but the text is added to the list in cells in `slot`, which is never NONE */
};

/* A step through a message in CDR. */
struct read_operation {
    uint8_t kind; /* enum read_kind */
    uint8_t size;
    uint8_t type; /* enum scalar */
    uint8_t reserved;
    uint16_t slot, padding;
    uint32_t count;
};

/* A message at one place: of protobuf the wanted fields, and all members of their oneofs, by ascending number; of CDR the
 * steps up to its last wanted field. */
struct node {
    union {
        const struct node_field *fields;
        const struct read_operation *steps;
    };
    uint32_t count;
    uint16_t first_slot, slot_count; /* of an element of a list: its own, with those of messages in it */
};

/* What programs have in common that read the same messages. */
struct layout {
    const struct node *nodes; /* the first one is the message; of a datagram the second one is the envelope around it */
    const struct value *defaults; /* what slots hold where nothing was read */
    const struct closed_enum *closed;
    const uint8_t *literals;
    uint32_t slot_count;
    uint32_t is_cdr;
};

#endif
