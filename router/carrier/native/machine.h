/* The machine that runs routines (operations.h): it reads a message into slots, evaluates conditions on it, and writes
 * the messages of targets from it. Each thread that does so has one of its own.
 *
 *     machine_begin(machine, layout);             slots have their defaults
 *     machine->slots[...] = ...;                  values other than fields: time of receipt, sender
 *     machine_read(machine, data, size);             fields are in slots now
 *     evaluate_condition(...), evaluate_message(...)   any number of times (evaluate.h)
 *
 * Text, bytes and lists in slots point into the message that was read: it must not change until the next begin. */
#ifndef MACHINE_H
#define MACHINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "events.h"
#include "operations.h"
#include "output.h"

enum {
    FIRST_CELLS = 16 * 1024, /* enough for a datagram: each element of a list takes at least a byte of it */
    /* A message that needs more is refused: */
    MOST_CELLS = 1 << 22, /* 96 MiB */
    MOST_WORK = 1 << 24,  /* turns of loops in all routines together, or BYTES_PER_TURN of text */
    BYTES_PER_TURN = 16
};

struct machine {
    const struct layout *layout;
    struct value *slots;
    struct cell *cells; /* moves when it grows */
    uint32_t cell_count, cell_capacity;
    uint8_t *text; /* MOST_TEXT bytes, for text that routines put together */
    size_t text_size;
    uint32_t work_left;                   /* of MOST_WORK */
    const uint8_t *message, *message_end; /* what was read last; offsets in CDR count from its first byte */
    struct output output;                 /* the message that was written last */
    struct refusal refusal;               /* what was refused last, */
    struct value refused;                 /* and its text, or an empty one */
    struct value stack[MOST_STACKED];
};

/* Note work that a routine does, in turns of loops. Return false if the message takes too much: lists that are gone
 * through for each element of others could hold up a thread for hours. */
static inline bool spend(struct machine *machine, size_t work) {
    bool is_enough = work <= machine->work_left;
    machine->work_left = is_enough ? machine->work_left - (uint32_t)work : 0;
    return is_enough;
}

/* Note why a message is refused. Returns false. */
static inline bool machine_refuse(struct machine *machine, struct refusal refusal) {
    machine->refusal = refusal;
    machine->refused.size = 0;
    return false;
}

/* Allocate what a machine needs. Return false for lack of memory. Close the machine in either case. */
bool machine_open(struct machine *machine);
void machine_close(struct machine *machine);

/* Begin with another message, of this layout: slots get their defaults, cells and text are freed. */
void machine_begin(struct machine *machine, const struct layout *layout);

/* Read a message into the slots. Return false if it is malformed, or for lack of memory. */
bool machine_read(struct machine *machine, const uint8_t *data, size_t size);

/* The same for a protobuf message in pieces (read_protobuf.h). */
bool machine_read_pieces(struct machine *machine, const uint8_t *data, size_t size);

/* Give the slots of a section their defaults, and read an element of a list of messages into them. */
bool machine_enter(struct machine *machine, uint16_t section, const struct value *element);

#endif
