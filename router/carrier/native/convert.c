#include "convert.h"

#include <string.h>

#include "numbers.h"
#include "utf8.h"

/* ---- reading ---- */

enum { HEADER = 4 };

/* A message that is being read. Positions are below its size, which is that of an object in memory. */
struct reader {
    const uint8_t *message;
    size_t size, at;
};

/* Step over `count` scalars of `size` bytes. Return false if the message ends before. */
static bool skip(struct reader *reader, uint64_t count, uint32_t size, size_t *start) {
    if (count) reader->at += (HEADER - reader->at) & (size - 1); /* sizes are powers of two */
    *start = reader->at;
    if (reader->at > reader->size || count > (reader->size - reader->at) / size) return false;
    reader->at += (size_t)count * size;
    return true;
}

static bool read_count(struct reader *reader, uint32_t *count) {
    size_t start;
    if (!skip(reader, 1, sizeof *count, &start)) return false;
    memcpy(count, reader->message + start, sizeof *count);
    return true;
}

/* A sequence of messages or strings, each of which takes at least one byte. */
struct repeat {
    size_t first; /* the operation after READ_REPEAT */
    uint32_t left;
};

static size_t behind_repeat(const struct read_op *ops, size_t at) {
    for (size_t open = 1; open; at++) {
        if (ops[at].kind == READ_REPEAT || ops[at].kind == READ_REPEAT_SEQUENCE) open++;
        if (ops[at].kind == READ_AGAIN) open--;
    }
    return at;
}

bool message_read(const struct read_op *ops, size_t count, const uint8_t *message, size_t size, struct slot *slots) {
    static const uint8_t CDR_LE[] = {0, 1};
    if (size < sizeof CDR_LE || memcmp(message, CDR_LE, sizeof CDR_LE) != 0) return false;
    struct reader reader = {message, size, HEADER};
    struct repeat repeats[MOST_REPEATS];
    size_t depth = 0;
    for (size_t at = 0; at < count;) {
        const struct read_op *op = &ops[at++];
        uint32_t many = op->count;
        size_t start;
        switch ((enum read_kind)op->kind) {
        case READ_SEQUENCE:
            if (!read_count(&reader, &many)) return false;
            /* fall through */
        case READ_SCALARS:
            if (!skip(&reader, many, op->size, &start)) return false;
            if (op->slot != NO_SLOT) slots[op->slot] = (struct slot){start, many};
            break;
        case READ_REPEAT_SEQUENCE:
            if (!read_count(&reader, &many)) return false;
            /* fall through */
        case READ_REPEAT:
            if (many) repeats[depth++] = (struct repeat){at, many};
            else at = behind_repeat(ops, at);
            break;
        case READ_AGAIN:
            if (--repeats[depth - 1].left) at = repeats[depth - 1].first;
            else depth--;
            break;
        }
    }
    return true;
}

/* ---- scalars ---- */

/* A scalar: of an integer or a bool `bits`, sign-extended to 64 bits; in any case `number`. */
struct value {
    uint64_t bits;
    double number;
};

/* Scalars in bytes, by enum scalar. */
static const uint8_t SIZES[] = {1, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8};

static struct value of_signed(uint64_t bits, unsigned size) {
    uint64_t sign = (uint64_t)1 << (8 * size - 1);
    uint64_t extended = (bits ^ sign) - sign;
    return (struct value){extended, (double)(int64_t)extended};
}

static struct value load(const uint8_t *from, enum scalar type) {
    uint64_t bits = load_little_endian(from, SIZES[type]);
    switch (type) {
    case SCALAR_INT8:
    case SCALAR_INT16:
    case SCALAR_INT32:
    case SCALAR_INT64: return of_signed(bits, SIZES[type]);
    case SCALAR_FLOAT32: return (struct value){0, of_float32(bits)};
    case SCALAR_FLOAT64: return (struct value){0, of_float64(bits)};
    case SCALAR_BOOL: return (struct value){bits != 0, bits != 0};
    default: return (struct value){bits, (double)bits};
    }
}

int64_t message_integer(const uint8_t *message, const struct slot *slot, enum scalar type) {
    return (int64_t)load(message + slot->start, type).bits;
}

/* ---- writing ---- */

/* A datagram that is being written from its end. `size` is counted also for what has no room. */
struct writer {
    uint8_t *end;
    size_t size;
};

/* Return where the next `size` bytes in front belong, or NULL if they have no room. */
static uint8_t *make_room(struct writer *writer, size_t size) {
    writer->size += size;
    return writer->size <= MOST_CONVERTED ? writer->end - writer->size : NULL;
}

static void write_bytes(struct writer *writer, const void *bytes, size_t size) {
    uint8_t *to = make_room(writer, size);
    if (to) memcpy(to, bytes, size);
}

static void write_little_endian(struct writer *writer, uint64_t value, unsigned size) {
    uint8_t bytes[8];
    store_little_endian(bytes, value, size);
    write_bytes(writer, bytes, size);
}

static void write_varint(struct writer *writer, uint64_t value) {
    uint8_t bytes[10];
    size_t size = 0;
    for (; value > 0x7F; value >>= 7) bytes[size++] = (uint8_t)(value | 0x80);
    bytes[size++] = (uint8_t)value;
    write_bytes(writer, bytes, size);
}

static uint64_t zigzag(uint64_t bits) { return bits << 1 ^ (bits >> 63 ? UINT64_MAX : 0); }

static uint64_t encoded(const struct value *value, enum encoding encoding) {
    switch (encoding) {
    case AS_ZIGZAG: return zigzag(value->bits);
    case AS_FLOAT: return float32_bits(value->number);
    case AS_DOUBLE: return float64_bits(value->number);
    default: return value->bits;
    }
}

static void write_encoded(struct writer *writer, uint64_t bits, enum encoding encoding) {
    if (encoding == AS_FIXED32 || encoding == AS_FLOAT) write_little_endian(writer, bits, 4);
    else if (encoding == AS_FIXED64 || encoding == AS_DOUBLE) write_little_endian(writer, bits, 8);
    else write_varint(writer, bits);
}

static void write_tag(struct writer *writer, const struct write_op *op) {
    if (op->tag) write_varint(writer, op->tag);
}

static bool write_scalar(struct writer *writer, const struct write_op *op, const uint8_t *from) {
    struct value value = load(from, op->scalar);
    if (op->flags & WANTS_FLOAT32 && !fits_float32(value.number)) return false;
    uint64_t bits = encoded(&value, op->encoding);
    if (!bits && !(op->flags & WRITES_DEFAULT)) return true;
    write_encoded(writer, bits, op->encoding);
    write_tag(writer, op);
    return true;
}

static bool write_list(struct writer *writer, const struct write_op *op, const uint8_t *first, uint32_t count) {
    if (count < op->least || count > op->most) return false;
    size_t before = writer->size;
    bool is_packed = op->flags & WRITES_PACKED;
    for (uint32_t left = count; left; left--) {
        struct value value = load(first + (size_t)(left - 1) * SIZES[op->scalar], op->scalar);
        write_encoded(writer, encoded(&value, op->encoding), op->encoding);
        if (!is_packed) write_tag(writer, op);
    }
    if (count && is_packed) {
        write_varint(writer, writer->size - before);
        write_tag(writer, op);
    }
    return true;
}

static bool write_delimited(struct writer *writer, const struct write_op *op, const uint8_t *bytes, uint32_t size) {
    if (size > op->most) return false;
    if (!size && !(op->flags & WRITES_DEFAULT)) return true;
    write_bytes(writer, bytes, size);
    write_varint(writer, size);
    write_tag(writer, op);
    return true;
}

/* Text with its final NUL, which some writers leave out of empty strings. */
static bool write_text(struct writer *writer, const struct write_op *op, const uint8_t *text, uint32_t size) {
    if (size && text[size - 1]) return false;
    uint32_t length = size ? size - 1 : 0;
    return is_utf8(text, length) && write_delimited(writer, op, text, length);
}

static bool write_from_slot(struct writer *writer, const struct write_op *op, const uint8_t *message,
                            const struct slot *slot) {
    const uint8_t *from = message + slot->start;
    switch ((enum write_kind)op->kind) {
    case WRITE_SCALAR: return write_scalar(writer, op, from);
    case WRITE_LIST: return write_list(writer, op, from, slot->count);
    case WRITE_TEXT: return write_text(writer, op, from, slot->count);
    default: return write_delimited(writer, op, from, slot->count);
    }
}

bool datagram_write(const struct write_op *ops, size_t count, const uint8_t *literals, const uint8_t *message,
                    const struct slot *slots, uint8_t *datagram, size_t *size) {
    struct writer writer = {datagram + MOST_CONVERTED, 0};
    size_t ends[MOST_OPEN], depth = 0; /* the size behind each message that is open */
    for (const struct write_op *op = ops; op < ops + count; op++) {
        if (op->kind == WRITE_LITERAL) {
            write_bytes(&writer, literals + op->start, op->count);
        } else if (op->kind == WRITE_END) {
            ends[depth++] = writer.size;
        } else if (op->kind == WRITE_BEGIN) {
            write_varint(&writer, writer.size - ends[--depth]);
            write_tag(&writer, op);
        } else if (!write_from_slot(&writer, op, message, &slots[op->slot])) {
            return false;
        }
    }
    *size = writer.size < MOST_CONVERTED ? writer.size : MOST_CONVERTED;
    return true;
}
