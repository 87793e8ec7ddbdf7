/* Computed text. It stays in the machine's text buffer until the routine, or the loop iteration that made it, ends.
 * Functions return false if the buffer is full or the message takes too much work. */
#ifndef TEXTS_H
#define TEXTS_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "lists.h"
#include "machine.h"

static inline struct value text_of(const void *bytes, size_t size) {
    return (struct value){.bytes = bytes, .size = (uint32_t)size};
}

/* Reserve `size` bytes of the buffer. Return NULL if that is refused. */
static inline uint8_t *take_text(struct machine *machine, size_t size) {
    if (size > MOST_TEXT - machine->text_size || !spend(machine, size / BYTES_PER_TURN)) return NULL;
    uint8_t *taken = machine->text + machine->text_size;
    machine->text_size += size;
    return taken;
}

static inline bool join(struct machine *machine, struct value *a, const struct value *b) {
    size_t size = (size_t)a->size + b->size;
    uint8_t *to = take_text(machine, size);
    if (!to) return false;
    if (a->size) memcpy(to, a->bytes, a->size);
    if (b->size) memcpy(to + a->size, b->bytes, b->size);
    *a = text_of(to, size);
    return true;
}

static inline bool to_decimal(struct machine *machine, struct value *number, bool is_unsigned) {
    uint8_t digits[20];
    size_t at = sizeof digits;
    bool is_negative = !is_unsigned && number->integer < 0;
    uint64_t rest = is_negative ? -number->bits : number->bits;
    do digits[--at] = (uint8_t)('0' + rest % 10);
    while (rest /= 10);
    struct value text = text_of(digits + at, sizeof digits - at);
    *number = text_of("-", is_negative);
    return join(machine, number, &text);
}

/* printf of glibc rounds correctly, and allocates nothing for a double. But it uses the decimal point of the process's
 * locale, which is replaced here. */
static inline bool to_digits(struct machine *machine, struct value *number, uint16_t decimals) {
    char printed[384]; /* -, 309 digits, a point of at most 16 bytes, 17 decimals */
    if (!isfinite(number->real)) {
        const char *word = isnan(number->real) ? "nan" : number->real < 0 ? "-inf" : "inf";
        *number = text_of(word, strlen(word));
        return true;
    }
    size_t size = (size_t)snprintf(printed, sizeof printed, "%.*f", (int)decimals, number->real);
    size_t whole = strspn(printed, "-0123456789");
    if (decimals) {
        memmove(printed + whole + 1, printed + size - decimals, decimals);
        printed[whole++] = '.';
    }
    struct value text = text_of(printed, whole + decimals);
    *number = text_of("", 0);
    return join(machine, number, &text);
}

static inline int64_t characters(const struct value *text) {
    int64_t count = 0;
    for (uint32_t index = 0; index < text->size; index++) count += (text->bytes[index] & 0xC0) != 0x80;
    return count;
}

static inline bool is_padding(uint8_t byte) { return byte == ' ' || byte == 0 || (byte >= '\t' && byte <= '\r'); }

static inline void strip(struct value *text) {
    while (text->size && is_padding(text->bytes[text->size - 1])) text->size--;
    for (; text->size && is_padding(*text->bytes); text->bytes++) text->size--;
}

/* Convert a list of integers to bytes. If that fails, record the refusal and return false. */
static inline bool to_octets(struct machine *machine, struct value *list, enum scalar stored) {
    if (stored == SCALAR_UINT8) return true;
    struct value octets = text_of(take_text(machine, list->size), list->size);
    if (!octets.bytes) return machine_refuse(machine, (struct refusal){.kind = REFUSED_ROOM});
    uint8_t *to = machine->text + machine->text_size - octets.size;
    while (list->size) {
        struct value element = list_next(machine, list, stored);
        if (element.bits > UINT8_MAX)
            return machine_refuse(machine, (struct refusal){REFUSED_INTEGER, 0, {element.integer, 0, UINT8_MAX}});
        *to++ = (uint8_t)element.bits;
    }
    *list = octets;
    return true;
}

#endif
