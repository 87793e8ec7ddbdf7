/* UTF-8 as in RFC 3629, which Python's strict decoder and protobuf accept. */
#ifndef UTF8_H
#define UTF8_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

static inline bool is_continuation(uint8_t byte) { return (byte & 0xC0) == 0x80; }

/* The size in bytes of the character at `at`, whose first byte is not ASCII, or 0 if it is invalid: overlong, a surrogate, or
 * beyond U+10FFFF, which the range of the second byte excludes. */
static inline size_t utf8_size(const uint8_t *at, size_t size) {
    uint8_t first = at[0], low = 0x80, high = 0xBF;
    size_t needed = first < 0xC2 ? 0 : first < 0xE0 ? 2 : first < 0xF0 ? 3 : first < 0xF5 ? 4 : 0;
    if (needed == 0 || needed > size) return 0;
    if (first == 0xE0) low = 0xA0;
    if (first == 0xED) high = 0x9F;
    if (first == 0xF0) low = 0x90;
    if (first == 0xF4) high = 0x8F;
    if (at[1] < low || at[1] > high) return 0;
    for (size_t index = 2; index < needed; index++) {
        if (!is_continuation(at[index])) return 0;
    }
    return needed;
}

static inline bool is_utf8(const uint8_t *text, size_t size) {
    for (size_t at = 0; at < size;) {
        size_t character = text[at] < 0x80 ? 1 : utf8_size(text + at, size - at);
        if (character == 0) return false;
        at += character;
    }
    return true;
}

#endif
