/* The wire format of protobuf: a message is a sequence of fields. A field is a tag, `number << 3 | wire type`, followed
 * by its value:
 *
 *     0  VARINT     7 bits per byte, the lowest first; the high bit says that another byte follows
 *     1  I64        8 bytes
 *     2  LEN        a varint with the size, then that many bytes: a string, bytes, a message, or packed scalars
 *     3  GROUP      fields, up to
 *     4  GROUP_END  with the same number
 *     5  I32        4 bytes */
#ifndef WIRE_H
#define WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { VARINT, I64, LEN, GROUP, GROUP_END, I32 };
enum {
    LONGEST_VARINT = 10,
    LONGEST_TAG = 5, /* bytes; the tag itself has 32 bits */
    LONGEST_SIZE = 5
};

/* The remaining bytes to read. */
struct bytes {
    const uint8_t *at, *end;
};

static inline size_t bytes_left(const struct bytes *bytes) { return (size_t)(bytes->end - bytes->at); }

/* Read a varint of at most `longest` bytes. It may be longer than necessary; bits beyond 64 are dropped. If it is cut or too
 * long, `value` is the part that was read. */
static inline bool read_varint(struct bytes *bytes, unsigned longest, uint64_t *value) {
    if (bytes->at < bytes->end && *bytes->at < 0x80) { /* as most are */
        *value = *bytes->at++;
        return true;
    }
    uint64_t read = 0;
    for (unsigned index = 0; index < longest && bytes->at < bytes->end; index++) {
        uint8_t byte = *bytes->at++;
        read |= (uint64_t)(byte & 0x7F) << (7 * index);
        if (byte < 0x80) {
            *value = read;
            return true;
        }
    }
    *value = read;
    return false;
}

static inline bool read_tag(struct bytes *bytes, uint32_t *tag) {
    uint64_t value;
    if (!read_varint(bytes, LONGEST_TAG, &value) || value > UINT32_MAX) return false;
    *tag = (uint32_t)value;
    return true;
}

static inline bool skip(struct bytes *bytes, uint64_t size) {
    if (size > bytes_left(bytes)) return false;
    bytes->at += size;
    return true;
}

/* Read the size of a LEN field, and skip the bytes. */
static inline bool read_len(struct bytes *bytes, struct bytes *value) {
    uint64_t size;
    if (!read_varint(bytes, LONGEST_SIZE, &size)) return false;
    value->at = bytes->at;
    if (!skip(bytes, size)) return false;
    value->end = bytes->at;
    return true;
}

/* Skip the value of a field that is neither LEN nor a group. */
static inline bool skip_scalar(struct bytes *bytes, uint32_t wire_type) {
    uint64_t number;
    switch (wire_type) {
    case VARINT: return read_varint(bytes, LONGEST_VARINT, &number);
    case I64: return skip(bytes, 8);
    case I32: return skip(bytes, 4);
    default: return false;
    }
}

/* Read the value of a field of a well-formed message. The `value` of a group includes its end. */
static inline bool read_value(struct bytes *bytes, uint32_t wire_type, struct bytes *value) {
    if (wire_type == LEN) return read_len(bytes, value);
    value->at = bytes->at;
    unsigned open = wire_type == GROUP;
    if (open == 0 && !skip_scalar(bytes, wire_type)) return false;
    while (open > 0) {
        uint32_t tag;
        struct bytes inner;
        if (!read_tag(bytes, &tag)) return false;
        switch (tag & 7) {
        case GROUP: open++; break;
        case GROUP_END: open--; break;
        case LEN:
            if (!read_len(bytes, &inner)) return false;
            break;
        default:
            if (!skip_scalar(bytes, tag & 7)) return false;
        }
    }
    value->end = bytes->at;
    return true;
}

/* Read the next piece of a message in several pieces: fields with one tag, perhaps with other fields between them. `tag` is
 * 0 before the first piece. */
static inline bool read_piece(struct bytes *bytes, uint32_t *tag, struct bytes *piece) {
    uint32_t found;
    do {
        if (!read_tag(bytes, &found) || !read_value(bytes, found & 7, piece)) return false;
        if (*tag == 0) *tag = found;
    } while (found != *tag);
    return true;
}

#endif
