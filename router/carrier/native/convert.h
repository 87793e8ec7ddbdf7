/* From a serialized ROS message to the datagram of a payload case, by two programs that compiler/commands.py makes.
 *
 * Plain CDR, little-endian: four bytes of header, then each scalar aligned to its own size, counted from behind the
 * header. Strings are their length with the final NUL (32 bits), then the bytes; sequences the number of elements, then
 * the elements. The first program finds where the wanted fields are.
 *
 * The second one writes protobuf from the last byte to the first: so the length of a message is known when it is
 * written, in front of it. The generated handlers have to give the same bytes, and refuse the same messages. */
#ifndef CONVERT_H
#define CONVERT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    MOST_SLOTS = 1024,     /* wanted fields of a message */
    MOST_REPEATS = 8,      /* sequences of sequences */
    MOST_OPEN = 32,        /* payloads in payloads */
    MOST_CONVERTED = 65536 /* bytes of a datagram: more than UDP takes */
};

/* Where a wanted field is: the first of `count` scalars, or bytes of text. */
struct slot {
    size_t start;
    uint32_t count;
};

enum read_kind {
    READ_SCALARS,  /* `count` scalars */
    READ_SEQUENCE, /* a length, then as many scalars; or a string */
    READ_REPEAT,   /* what follows, up to its READ_AGAIN, `count` times */
    READ_REPEAT_SEQUENCE, /* likewise, but a length says how often */
    READ_AGAIN
};
enum { NO_SLOT = UINT16_MAX };

struct read_op {
    uint8_t kind; /* enum read_kind */
    uint8_t size; /* of a scalar, and its alignment */
    uint16_t slot; /* NO_SLOT for what is not wanted */
    uint32_t count;
};

/* Types of scalars in a message. */
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
    SCALAR_FLOAT64
};

/* How protobuf has a scalar. */
enum encoding { AS_VARINT, AS_ZIGZAG, AS_FIXED32, AS_FIXED64, AS_FLOAT, AS_DOUBLE };

enum write_kind {
    WRITE_LITERAL, /* `count` bytes of the literals, from `start` */
    WRITE_SCALAR,
    WRITE_LIST,  /* a repeated scalar of `least` to `most` elements */
    WRITE_TEXT,  /* a string of at most `most` bytes */
    WRITE_BYTES, /* likewise */
    WRITE_END,   /* comes first: what is written up to its WRITE_BEGIN has tag and length in front */
    WRITE_BEGIN
};

enum write_flag {
    WRITES_DEFAULT = 1, /* it has presence: zero and the empty string are written as well */
    WRITES_PACKED = 2,
    WANTS_FLOAT32 = 4 /* a finite number that is infinite as a float32 is refused */
};

struct write_op {
    uint8_t kind;     /* enum write_kind */
    uint8_t scalar;   /* enum scalar */
    uint8_t encoding; /* enum encoding */
    uint8_t flags;    /* enum write_flag */
    uint16_t slot, reserved;
    uint32_t tag; /* field number << 3 | wire type; 0: none, for an element of packed ones */
    uint32_t least, most;
    uint32_t start, count;
};

/* Find the slots in a message of `size` bytes. Return false if it is no such message. */
bool message_read(const struct read_op *ops, size_t count, const uint8_t *message, size_t size, struct slot *slots);

/* A scalar of a slot, for integers only. */
int64_t message_integer(const uint8_t *message, const struct slot *slot, enum scalar type);

/* Write the datagram to the end of `datagram`, which has MOST_CONVERTED bytes, and set its size. Return false if the
 * message has a value that the payload cannot hold. What is longer than UDP takes has a size of MOST_CONVERTED; its bytes
 * mean nothing. */
bool datagram_write(const struct write_op *ops, size_t count, const uint8_t *literals, const uint8_t *message,
                    const struct slot *slots, uint8_t *datagram, size_t *size);

#endif
