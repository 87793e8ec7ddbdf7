#include "board.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "numbers.h"
#include "wire.h"

enum { MOST_LEVELS = 100 /* the limit of envelope.c */ };

struct level {
    const uint8_t *end;
    const struct board_message *message;
    uint64_t seen; /* required fields */
};

struct check {
    const struct board *board;
    struct board_refusal *refusal;
    struct bytes rest; /* of the innermost message */
    unsigned depth;
    struct level levels[MOST_LEVELS + 1];
    uint32_t counts[MOST_BOARD_COUNTERS];
};

/* ---- bounds: each function returns whether the board takes the value ---- */

static bool fits(uint64_t size, uint32_t bound, bool is_fixed) {
    return is_fixed ? size == 0 || size == bound : size <= bound;
}

static bool too_large(struct check *check, const char *path, uint64_t found, const char *unit, uint32_t bound) {
    check->refusal->reason = DROP_TOO_LARGE;
    snprintf(check->refusal->text, sizeof check->refusal->text, "%s has %llu %s%s; the board takes %u", path,
             (unsigned long long)found, unit, found == 1 ? "" : "s", bound);
    return false;
}

static bool takes_length(struct check *check, const struct board_field *field, size_t length) {
    if (fits(length, field->longest, field->flags & BOARD_HAS_FIXED_LENGTH)) return true;
    return too_large(check, field->path, length, "byte", field->longest);
}

static bool takes_number(struct check *check, const struct board_field *field, const uint8_t *at) {
    if (!(field->flags & BOARD_IS_FLOAT) || check->board->allows_non_finite) return true;
    double number = field->kind == WIRE_I64 ? of_float64(load_little_endian(at, 8)) : of_float32(load_little_endian(at, 4));
    if (isfinite(number)) return true;
    check->refusal->reason = DROP_NON_FINITE;
    snprintf(check->refusal->text, sizeof check->refusal->text, "%s is %s", field->path,
             isnan(number) ? "nan" : number > 0 ? "inf" : "-inf");
    return false;
}

static bool takes_integer(struct check *check, const struct board_field *field, uint64_t value) {
    int64_t number = field->flags & BOARD_IS_ZIGZAG ? (int64_t)(value >> 1) ^ -(int64_t)(value & 1) : (int64_t)value;
    if (number >= field->low && number <= field->high) return true;
    check->refusal->reason = DROP_TOO_LARGE;
    long long low = field->low, high = field->high;
    const char *format = low ? "%s is %lld; the board takes %lld to %lld" : "%s is %llu; the board takes %lld to %lld";
    snprintf(check->refusal->text, sizeof check->refusal->text, format, field->path, (long long)number, low, high);
    return false;
}

static bool takes_varint(struct check *check, const struct board_field *field, struct bytes value) {
    uint64_t number;
    if (!(field->flags & BOARD_HAS_RANGE) || !read_varint(&value, LONGEST_VARINT, &number)) return true;
    return takes_integer(check, field, number);
}

/* Count elements of a repeated field. */
static bool takes_more(struct check *check, const struct board_field *field, uint64_t elements) {
    if (!(field->flags & BOARD_IS_REPEATED)) return true;
    uint64_t total = check->counts[field->counter] + elements;
    bool is_empty = !elements && field->flags & BOARD_HAS_FIXED_COUNT;
    if (total > field->most || is_empty) return too_large(check, field->path, total, "element", field->most);
    check->counts[field->counter] = (uint32_t)total;
    return true;
}

/* Whether a completely read message has all required fields. nanopb expects them in each piece of a message. */
static bool has_required_fields(struct check *check, const struct level *level) {
    uint64_t missing = level->message->required & ~level->seen;
    if (!missing) return true;
    const struct board_field *field = level->message->fields;
    while (!(field->required & missing)) field++;
    check->refusal->reason = DROP_MISSING_FIELD;
    snprintf(check->refusal->text, sizeof check->refusal->text, "%s is missing; the board requires it", field->path);
    return false;
}

/* Whether the lists of a completely read message have all their elements. */
static bool has_all_elements(struct check *check, const struct board_message *message) {
    for (uint32_t index = 0; index < message->count; index++) {
        const struct board_field *field = &message->fields[index];
        if (!(field->flags & BOARD_HAS_FIXED_COUNT)) continue;
        uint32_t count = check->counts[field->counter];
        if (!fits(count, field->most, true)) return too_large(check, field->path, count, "element", field->most);
    }
    return true;
}

/* ---- values ---- */

static const struct board_field *find_field(const struct board_message *message, uint32_t number) {
    uint32_t low = 0, high = message->count;
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        if (message->fields[middle].number == number) return &message->fields[middle];
        if (message->fields[middle].number < number) low = middle + 1;
        else high = middle;
    }
    return NULL;
}

static bool takes_packed_varints(struct check *check, const struct board_field *field, struct bytes values) {
    struct bytes rest = values;
    uint64_t count = 0, value;
    while (rest.at < rest.end && read_varint(&rest, LONGEST_VARINT, &value)) count++;
    if (!takes_more(check, field, count)) return false;
    for (; count && field->flags & BOARD_HAS_RANGE; count--)
        if (!read_varint(&values, LONGEST_VARINT, &value) || !takes_integer(check, field, value)) return false;
    return true;
}

static bool takes_packed(struct check *check, const struct board_field *field, struct bytes values) {
    if (field->kind == WIRE_VARINT) return takes_packed_varints(check, field, values);
    size_t size = field->kind == WIRE_I64 ? 8 : 4;
    if (!takes_more(check, field, bytes_left(&values) / size)) return false;
    for (; bytes_left(&values) >= size; values.at += size)
        if (!takes_number(check, field, values.at)) return false;
    return true;
}

/* Enter a message. A list element begins with empty lists; a repeated singular message is merged. */
static bool enter(struct check *check, const struct board_field *field, const uint8_t *end) {
    const struct board_message *message = &check->board->messages[field->message];
    if (check->depth == MOST_LEVELS) return too_large(check, field->path, MOST_LEVELS + 1, "level", MOST_LEVELS);
    if (field->flags & BOARD_IS_REPEATED)
        memset(&check->counts[message->first_counter], 0, message->counter_count * sizeof *check->counts);
    check->levels[++check->depth] = (struct level){.end = end, .message = message};
    check->rest.end = end;
    return true;
}

static bool takes_len(struct check *check, const struct board_field *field, struct bytes value) {
    switch (field->kind) {
    case WIRE_MESSAGE:
        check->rest.at = value.at;
        return takes_more(check, field, 1) && enter(check, field, value.end);
    case WIRE_BYTES: return takes_more(check, field, 1) && takes_length(check, field, bytes_left(&value));
    default: return takes_packed(check, field, value);
    }
}

static bool takes_field(struct check *check) {
    uint32_t tag;
    struct bytes value;
    /* Neither fails, as the envelope is well formed. */
    if (!read_tag(&check->rest, &tag) || !read_value(&check->rest, tag & 7, &value)) return true;
    struct level *level = &check->levels[check->depth];
    const struct board_field *field = find_field(level->message, tag >> 3);
    if (!field || !(field->wire_types & 1u << (tag & 7))) return true; /* protobuf skips it */
    level->seen |= field->required;
    switch (tag & 7) {
    case LEN: return takes_len(check, field, value);
    case VARINT: return takes_more(check, field, 1) && takes_varint(check, field, value);
    default: return takes_more(check, field, 1) && takes_number(check, field, value.at);
    }
}

static bool takes_fields(struct check *check) {
    for (;;) {
        if (check->rest.at < check->rest.end) {
            if (!takes_field(check)) return false;
        } else {
            const struct level *level = &check->levels[check->depth];
            if (!has_required_fields(check, level) || !has_all_elements(check, level->message)) return false;
            if (check->depth == 0) return true;
            check->rest.end = check->levels[--check->depth].end;
        }
    }
}

bool board_takes(const struct board *board, const uint8_t *data, size_t size, struct board_refusal *refusal) {
    struct check check; /* initialized only where needed, as it is large */
    check.board = board;
    check.refusal = refusal;
    if (size > board->longest) return too_large(&check, "the envelope", size, "byte", board->longest);
    memset(check.counts, 0, board->messages->counter_count * sizeof *check.counts);
    check.rest = (struct bytes){data, data + size};
    check.depth = 0;
    check.levels[0] = (struct level){.end = data + size, .message = board->messages};
    return takes_fields(&check);
}
