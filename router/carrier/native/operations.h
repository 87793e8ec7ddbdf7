/* The format of routines, for all directions. A layout says which fields a reader stores in which slots (read_protobuf.h,
 * read_cdr.h). Operations compute with slots on a stack (evaluate.h); some of them write a message (write_cdr.h,
 * write_protobuf.h). router/compiler/lowering makes routines from checked expressions.
 *
 * Values carry no type: the compiler knows the type of each one, and the range of each integer. Integers have 64 bits,
 * signed or unsigned. If a result may not fit, an operation checks it. An operation without a result refuses the
 * message. */
#ifndef OPERATIONS_H
#define OPERATIONS_H

#include <stdint.h>

enum {
    MOST_STACKED = 256,  /* values at once; the first one is never used */
    MOST_LOOPS = 8,      /* depth of nested loops */
    MOST_OPEN = 32,      /* depth of nested payloads while writing */
    MOST_TEXT = 1 << 20  /* bytes of text that a routine computes; the compiler checks the sum */
};
enum { NONE = UINT16_MAX }; /* no such slot, section or enum */

/* ---- values ---- */

/* A list in cells. `first` and `last` have no meaning if it is empty. */
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

/* Scalar types of CDR, and how a list is stored: as an array of `size` scalars at `bytes`, or in cells. */
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

/* Operands come from the stack, and the result replaces them there. "Refuses" means that the message is dropped. */
enum op {
    /* Values: */
    OP_INTEGER, /* pushes `integer` */
    OP_REAL,    /* pushes `real` */
    OP_TEXT,    /* pushes `size` bytes of the literals, from `integer` */
    OP_LOAD,    /* pushes the value in `slot` */
    OP_KEEP,    /* copies the top value to `slot` */
    OP_DROP,    /* pops a value */
    OP_STATE,   /* copies the present value of the layout's state `integer` to `slot`, and a text to the machine's buffer */
    /* Integers. `flag` (enum sign) says which operands are unsigned, and whether the result is. The plain operations wrap
     * around at 2^64, and are for results that always fit. The CHECKED ones, and division, refuse a result that does not: */
    OP_ADD,
    OP_SUBTRACT,
    OP_MULTIPLY,
    OP_CHECKED_ADD,
    OP_CHECKED_SUBTRACT,
    OP_CHECKED_MULTIPLY,
    OP_CHECKED_NEGATE,
    OP_NEGATE,
    OP_ABSOLUTE, /* of a signed integer; the result may be 2^63, and is unsigned then */
    OP_DIVIDE,   /* rounds down; refuses the divisor 0 */
    OP_MODULO,   /* has the sign of the divisor; refuses the divisor 0 */
    OP_LEAST,    /* the smaller one of two */
    OP_GREATEST, /* the larger one of two */
    OP_CLAMP,    /* x, low, high: the bound that x exceeds, else x */
    OP_FIT,      /* x, low, high: refuses x outside of the bounds */
    OP_WRAP,     /* x, low, high: x, moved between the bounds by multiples of their distance; refuses low > high */
    /* Real numbers: */
    OP_REAL_ADD,
    OP_REAL_SUBTRACT,
    OP_REAL_MULTIPLY,
    OP_REAL_DIVIDE,       /* refuses the divisor 0 */
    OP_REAL_FLOOR_DIVIDE, /* likewise */
    OP_REAL_MODULO,       /* likewise */
    OP_REAL_POWER,        /* like the functions below, refuses if there is no result or finite operands give infinity */
    OP_REAL_NEGATE,
    OP_REAL_ABSOLUTE,
    OP_REAL_LEAST,
    OP_REAL_GREATEST,
    OP_REAL_CLAMP,
    OP_SQRT,
    OP_SIN,
    OP_COS,
    OP_TAN,
    OP_ATAN2,
    OP_HYPOT,
    OP_FLOAT32, /* refuses a finite number that is infinite as a float32; the number stays a double */
    /* Conversions: */
    OP_INTEGER_TO_REAL, /* `flag` 1: the integer is unsigned */
    OP_ROUND,           /* ties go to the even integer. These four give a signed integer. They refuse NaN and infinity as
                           DROP_NON_FINITE, and numbers beyond 64 bits as DROP_MAPPING_ERROR */
    OP_TRUNCATE,
    OP_FLOOR,
    OP_CEIL,
    /* Booleans are the integers 0 and 1: */
    OP_COMPARE, /* `flag` is the enum relation, `slot` the enum compared */
    OP_NOT,
    OP_JUMP,   /* skips the next `size` operations */
    OP_UNLESS, /* pops a boolean, and skips `size` operations if it is false */
    OP_AND,    /* skips `size` operations if the top is false, else pops it */
    OP_OR,     /* skips `size` operations if the top is true, else pops it */
    OP_EITHER, /* `or` of two booleans, both of which are evaluated */
    /* Text and bytes: */
    OP_JOIN,
    OP_DECIMAL,    /* an integer as text; `flag` 1: it is unsigned */
    OP_DIGITS,     /* a real number as text with `slot` decimals, or as "nan", "inf" or "-inf" */
    OP_CHARACTERS, /* the number of characters in UTF-8 */
    OP_SIZE,       /* the number of bytes, or of a list's elements */
    OP_FIT_SIZE,   /* refuses more than `integer` bytes */
    OP_STRIP,      /* text without the blanks and NULs at both of its ends: space, tab, line feed, vertical tab, form feed
                      and carriage return */
    OP_UTF8,       /* refuses text that is not UTF-8 */
    OP_NAMELESS,   /* refuses the text as a name that the enum lacks */
    OP_OCTETS,     /* a list of integers, stored as `flag` says, as bytes; refuses integers beyond 0 to 255 */
    OP_MEMBER,     /* refuses an integer that is not among `size` ascending int32 in the literals, from `integer` */
    /* Lists. `flag` (enum scalar) says how a list is stored: */
    OP_FIT_COUNT,  /* refuses a number of elements other than `integer`; `flag` 1: refuses only a larger one */
    OP_SAME_COUNT, /* pops a number of elements, and refuses it unless the next one is equal */
    OP_ELEMENT, /* the element with the index `integer`; refuses a list without it */
    OP_ENTER,   /* pops a message, and reads it into section `slot` */
    OP_REPEAT,  /* pops an integer, and repeats the next `size` operations that many times; the last of them is its OP_AGAIN.
                   `flag` 1: their cells and text are kept; else each iteration frees its own */
    OP_AGAIN,
    OP_NEXT,   /* removes the first element from the list in `slot`, and pushes it */
    OP_LIST,   /* pops `size` values, and pushes a list of them in cells */
    OP_UNPACK, /* converts a list of scalars to cells */
    OP_APPEND, /* pops a value, and appends it to the list in cells in `slot` */
    /* A message, from its first byte on. In CDR, the constant bytes begin with the header: */
    OP_KNOWN, /* writes `size` bytes of the literals, from `integer`, aligned to `slot`, which is 1 in protobuf */
    /* A message in CDR. Alignment is relative to the end of the header. Each pops a value: */
    OP_PUT,        /* writes the lowest `slot` bytes of an integer, aligned to their number */
    OP_PUT_FLOAT,  /* refuses a finite number that is infinite as a float32 */
    OP_PUT_DOUBLE,
    OP_PUT_TEXT,   /* refuses text with a NUL */
    OP_PUT_BYTES,  /* without a length prefix */
    /* A message in protobuf. `size` is the tag, field number << 3 | wire type, or 0 for none, for packed elements. Each
     * OP_WRITE pops a value, and writes zero and the empty string only if `flag` is 1: */
    OP_OPEN, /* begins a message or packed elements, up to its OP_CLOSE, with tag and length. `flag` 0: omitted if empty */
    OP_CLOSE,
    OP_WRITE_VARINT,
    OP_WRITE_ZIGZAG,
    OP_WRITE_FIXED32,
    OP_WRITE_FIXED64,
    OP_WRITE_FLOAT, /* refuses a finite number that is infinite as a float32 */
    OP_WRITE_DOUBLE,
    OP_WRITE_BYTES, /* and text */
    OP_PAYLOAD /* writes the payload of the datagram, as it was received */
};

/* Which operands of an operation with integers are unsigned, and whether its result is. */
enum sign { FIRST_UNSIGNED = 1, SECOND_UNSIGNED = 2, THIRD_UNSIGNED = 4, RESULT_UNSIGNED = 8 };

enum relation { EQUAL, UNEQUAL, LESS, LESS_OR_EQUAL, GREATER, GREATER_OR_EQUAL };

/* The types of an exact comparison, the left operand first. */
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
    uint8_t kind; /* enum op */
    uint8_t flag;
    uint16_t slot;
    uint32_t size;
    union {
        int64_t integer;
        double real;
        uint64_t bits;
    };
};

/* A sequence of operations that evaluates a condition, writes a message, or gives a value. */
struct routine {
    const struct operation *operations;
    uint32_t count, reserved;
};

/* ---- reading ---- */

enum field_type {
    TYPE_BOOL,
    TYPE_INT32, /* and open enums */
    TYPE_INT64, /* and uint64: the same bits */
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
    TYPE_CLOSED_ENUM /* a number that the enum lacks is an unknown field */
};

/* A wanted field of a protobuf message, or a member of its oneof. */
struct wanted_field {
    uint32_t number;
    uint8_t type; /* enum field_type */
    uint8_t is_repeated;
    uint16_t slot;     /* of its value or list, or NONE */
    uint16_t presence; /* slot that is set to 1 if the field is present, or NONE */
    uint16_t section;  /* for a message that is not repeated, or NONE */
    uint16_t choice;   /* slot for the number of the oneof's present member, or NONE */
    uint16_t cleared, cleared_count; /* slots of the oneof's members */
    uint16_t closed;   /* index of the layout's closed enums, or NONE */
};

struct closed_enum {
    const int32_t *numbers; /* ascending */
    uint32_t count, reserved;
};

enum read_kind {
    READ_SCALAR,        /* of `type`, into `slot` */
    READ_SKIP,          /* skips `count` scalars of `size` bytes, which is also their alignment */
    READ_ARRAY,         /* `count` scalars of `size` bytes: a list of them into `slot`, which is never NONE */
    READ_SEQUENCE,      /* likewise, but the number of scalars comes first; NONE: skips them */
    READ_TEXT,          /* the number of bytes with the final NUL, then the bytes; into `slot` without the NUL, or NONE */
    READ_EACH,          /* repeats the next steps, up to its READ_AGAIN, `count` times. `slot`: a list in cells that gets the
                           place where each element begins, or NONE */
    READ_EACH_SEQUENCE, /* likewise, but the number of elements comes first */
    READ_AGAIN,
    READ_TEXTS /* like READ_TEXT, but adds the text to the list in cells in `slot`, which is never NONE */
};

/* A step in reading a CDR message. */
struct read_operation {
    uint8_t kind; /* enum read_kind */
    uint8_t size;
    uint8_t type; /* enum scalar */
    uint8_t reserved;
    uint16_t slot, padding;
    uint32_t count;
};

/* A message at one place. In protobuf: its wanted fields and all members of their oneofs, by ascending number. In CDR: the
 * steps up to its last wanted field. */
struct section {
    union {
        const struct wanted_field *fields;
        const struct read_operation *steps;
    };
    uint32_t count;
    uint16_t first_slot, slot_count; /* for a list element: its slots, including those of nested messages */
};

struct state_settings;

/* The common part of routines that read the same messages. */
struct layout {
    const struct section *sections; /* the first one is the message */
    const struct value *defaults; /* the values of slots before reading */
    const struct closed_enum *closed;
    const uint8_t *literals;
    uint32_t slot_count;
    uint16_t is_cdr;
    uint16_t envelope; /* section of the envelope of a datagram, 0 if no routine needs it (machine_read_envelope) */
    const struct state_settings *states; /* of the program; NULL without any */
};

#endif
