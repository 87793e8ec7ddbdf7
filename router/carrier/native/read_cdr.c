#include "read_cdr.h"

#include <string.h>

#include "lists.h"

enum { HEADER = 4 };

/* The message being read, and the current offset. */
struct reader {
    const uint8_t *message;
    size_t size, at;
};

/* A sequence or array of messages or strings. */
struct repetition {
    const struct read_operation *first; /* of an element */
    uint32_t left;                      /* elements, including this one */
    uint16_t list;                      /* slot for the beginnings of the elements, or NONE */
};

/* Skip `count` scalars of `size` bytes; `start` is set to the first one. Return false if the message ends before. */
static bool skip_scalars(struct reader *reader, uint32_t count, unsigned size, const uint8_t **start) {
    if (count) reader->at += (HEADER - reader->at) & (size - 1); /* sizes are powers of two */
    if (reader->at > reader->size || count > (reader->size - reader->at) / size) return false;
    *start = reader->message + reader->at;
    reader->at += (size_t)count * size;
    return true;
}

static bool read_count(struct reader *reader, uint32_t *count) {
    const uint8_t *start;
    if (!skip_scalars(reader, 1, sizeof *count, &start)) return false;
    *count = (uint32_t)load_little_endian(start, sizeof *count);
    return true;
}

static bool read_scalar(struct reader *reader, enum scalar type, struct value *value) {
    const uint8_t *start;
    if (!skip_scalars(reader, 1, scalar_size(type), &start)) return false;
    *value = scalar_load(start, type);
    return true;
}

static bool read_array(struct reader *reader, uint32_t count, unsigned size, struct value *list) {
    const uint8_t *start;
    if (!skip_scalars(reader, count, size, &start)) return false;
    if (list) *list = (struct value){.bytes = start, .size = count};
    return true;
}

/* Some writers omit the NUL of an empty string, so that its length is 0. Other text without a NUL is read as text that is not
 * UTF-8, so that only a routine that uses it refuses the message. */
static bool read_text(struct reader *reader, struct value *text) {
    static const uint8_t NO_UTF8[] = {0xFF};
    uint32_t size;
    if (!read_count(reader, &size) || !read_array(reader, size, 1, text)) return false;
    if (!text || !size) return true;
    if (text->bytes[size - 1]) *text = (struct value){.bytes = NO_UTF8, .size = sizeof NO_UTF8};
    else text->size--;
    return true;
}

/* The READ_AGAIN of a repetition. */
static const struct read_operation *end_of(const struct read_operation *step) {
    for (unsigned open = 1;;) {
        step++;
        if (step->kind == READ_EACH || step->kind == READ_EACH_SEQUENCE) open++;
        if (step->kind == READ_AGAIN && --open == 0) return step;
    }
}

static bool add_beginning(struct machine *machine, const struct reader *reader, uint16_t list) {
    if (list == NONE) return true;
    size_t rest = reader->size - reader->at;
    struct value beginning = {.bytes = reader->message + reader->at, .size = rest < UINT32_MAX ? (uint32_t)rest : UINT32_MAX};
    return list_add(machine, &machine->slots[list], beginning);
}

static bool read_steps(struct machine *machine, struct reader *reader, const struct section *section) {
    struct value *slots = machine->slots;
    struct repetition repetitions[MOST_LOOPS + 1], *inner = repetitions; /* the first one is never used */
    for (const struct read_operation *step = section->steps, *end = step + section->count; step < end; step++) {
        struct value *slot = step->slot == NONE ? NULL : &slots[step->slot], text;
        uint32_t count = step->count;
        switch ((enum read_kind)step->kind) {
        case READ_SCALAR:
            if (!read_scalar(reader, step->type, slot)) return false;
            break;
        case READ_SKIP:
            if (!read_array(reader, count, step->size, NULL)) return false;
            break;
        case READ_SEQUENCE:
            if (!read_count(reader, &count)) return false;
            /* fall through */
        case READ_ARRAY:
            if (!read_array(reader, count, step->size, slot)) return false;
            break;
        case READ_TEXT:
            if (!read_text(reader, slot)) return false;
            break;
        case READ_TEXTS:
            if (!read_text(reader, &text) || !list_add(machine, slot, text)) return false;
            break;
        case READ_EACH_SEQUENCE:
            /* each element takes at least one byte */
            if (!read_count(reader, &count) || count > reader->size - reader->at) return false;
            /* fall through */
        case READ_EACH:
            if (!count) {
                step = end_of(step);
                break;
            }
            *++inner = (struct repetition){step, count, step->slot};
            if (!add_beginning(machine, reader, inner->list)) return false;
            break;
        case READ_AGAIN:
            if (!--inner->left) {
                inner--;
                break;
            }
            step = inner->first;
            if (!add_beginning(machine, reader, inner->list)) return false;
            break;
        }
    }
    return true;
}

bool read_cdr(struct machine *machine, uint16_t section, const uint8_t *message, size_t size) {
    static const uint8_t CDR_LE[] = {0, 1};
    if (size < HEADER || memcmp(message, CDR_LE, sizeof CDR_LE) != 0) return false;
    machine->message = message;
    machine->message_end = message + size;
    struct reader reader = {message, size, HEADER};
    return read_steps(machine, &reader, &machine->layout->sections[section]);
}

bool read_cdr_element(struct machine *machine, uint16_t section, const uint8_t *beginning) {
    struct reader reader = {machine->message, (size_t)(machine->message_end - machine->message),
                            (size_t)(beginning - machine->message)};
    return read_steps(machine, &reader, &machine->layout->sections[section]);
}
