/* Checks datagrams for boards, whose firmware decodes with nanopb into structures of a fixed size.
 *
 * The checks cover the sizes of the envelope, of strings and bytes, the number of elements, that numbers are finite,
 * integers that `int_size` bounds, and that no required field is missing. They do not cover other data that nanopb
 * rejects: a field with a wrong wire type, an integer with more bits than its type, a negative number in an enum that
 * declares none, an unknown group. tests/oracles/boards.py is a second implementation. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "envelope.h"
#include "events.h"

enum { MOST_BOARD_COUNTERS = 4096 };

enum board_flag {
    BOARD_IS_FLOAT = 1,
    BOARD_IS_REPEATED = 2,      /* at most `most` elements */
    BOARD_HAS_FIXED_LENGTH = 4, /* `longest` bytes, or none */
    BOARD_HAS_FIXED_COUNT = 8,  /* `most` elements, or none */
    BOARD_HAS_RANGE = 16,       /* integers from `low` to `high` */
    BOARD_IS_ZIGZAG = 32
};

struct board_field {
    uint32_t number;
    uint8_t kind;     /* enum wire_kind; WIRE_BYTES also for strings */
    uint8_t flags;    /* of enum board_flag */
    uint16_t message; /* index of the message, for a message */
    uint32_t longest; /* of a string or bytes */
    uint32_t most;
    uint32_t counter; /* of elements */
    uint32_t wire_types; /* a bit for each declared one: of the type, and of its packed form */
    int64_t low, high;
    uint64_t required; /* its bit among the required fields of its message, or 0 */
    const char *path; /* from the payload case on: "arm_ctrl.name" */
    uint64_t reserved; /* 64 bytes in total make the search cheaper */
};

/* A message at one place in the tree of an envelope. Each place has its own, with its own counters. The counters of
 * everything inside a message are consecutive. */
struct board_message {
    const struct board_field *fields; /* the checked fields, by ascending number */
    uint32_t count;
    uint32_t first_counter, counter_count;
    uint32_t reserved;
    uint64_t required; /* the bits of its required fields: of the first 64 ones, like nanopb */
};

struct board {
    const struct board_message *messages; /* the first one is the envelope */
    uint32_t longest;                     /* of an envelope */
    uint32_t allows_non_finite;
};

struct board_refusal {
    enum drop_reason reason; /* DROP_TOO_LARGE, DROP_NON_FINITE or DROP_MISSING_FIELD */
    char text[256];
};

/* Whether a board can take an envelope that is well formed. */
bool board_takes(const struct board *board, const uint8_t *data, size_t size, struct board_refusal *refusal);

#endif
