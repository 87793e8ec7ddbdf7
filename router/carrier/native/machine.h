/* The machine that runs programs (operations.h): it reads a message into slots, evaluates conditions on it, and writes
 * the messages of targets from it. Each thread that does so has one of its own.
 *
 *     machine_begin(machine, layout);             slots have their defaults
 *     machine->slots[...] = ...;                  what is no field: the time of receipt, the sender's name
 *     machine_read(machine, node, data, size);    fields are in slots now
 *     evaluate_condition(...), evaluate_message(...)   any number of times (evaluate.h)
 *
 * Text, bytes and lists in slots point into the message that was read, which has to stay until the next begin. */
#ifndef MACHINE_H
#define MACHINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "operations.h"
#include "output.h"

enum {
    FIRST_CELLS = 16 * 1024, /* enough for a datagram: each element of a list takes at least a byte of it */
    MOST_CELLS = 1 << 22     /* 128 MiB; a message that needs more is refused */
};

struct machine {
    const struct layout *layout;
    struct value *slots;
    struct cell *cells; /* moves when it grows */
    uint32_t cell_count, cell_capacity;
    uint8_t *text; /* MOST_TEXT bytes, for text that programs put together */
    size_t text_size;
    const uint8_t *message, *message_end; /* what was read last; offsets in CDR count from its first byte */
    struct output output;                 /* the message that was written last */
    struct value stack[MOST_STACKED];
};

/* Allocate what a machine needs. Return false for lack of memory. To be closed in either case. */
bool machine_open(struct machine *machine);
void machine_close(struct machine *machine);

/* Begin with another message, of this layout: all slots get their defaults, cells and text are free again. */
void machine_begin(struct machine *machine, const struct layout *layout);

/* Read a message into the slots of a node. Return false if it is malformed, or for lack of memory. */
bool machine_read(struct machine *machine, uint16_t node, const uint8_t *data, size_t size);

/* Give the slots of a node their defaults, and read an element of a list of messages into them. */
bool machine_enter(struct machine *machine, uint16_t node, const struct value *element);

#endif
