/* The machine that runs routines (operations.h): it reads a message into slots, evaluates conditions on it, and writes the
 * messages of targets. Each thread has its own machine.
 *
 *     machine_begin(machine, layout);                  set slots to their defaults
 *     machine->slots[...] = ...;                       values other than fields: time of receipt, sender
 *     machine_read(machine, data, size);               read fields into slots
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
    FIRST_CELLS = 16 * 1024, /* enough for a datagram, in which each list element takes at least a byte */
    /* Messages that need more are refused: */
    MOST_CELLS = 1 << 22, /* 96 MiB */
    MOST_WORK = 1 << 24,  /* loop iterations in all routines together, or BYTES_PER_TURN of text */
    BYTES_PER_TURN = 16
};

struct datagram;
struct thread_env;

struct machine {
    const struct layout *layout;
    struct thread_env *env; /* its clock decides whether states have expired; NULL if no routine reads one */
    struct value *slots;
    struct cell *cells; /* its address changes when it grows */
    uint32_t cell_count, cell_capacity;
    uint8_t *text; /* MOST_TEXT bytes, for computed text */
    size_t text_size;
    uint32_t work_left;                   /* of MOST_WORK */
    const uint8_t *message, *message_end; /* the last message read; offsets in CDR count from its first byte */
    const struct datagram *datagram;      /* of the last envelope read */
    struct output output;                 /* the last message written */
    struct refusal refusal;               /* the last refusal, */
    struct value refused;                 /* and its text, or an empty one */
    struct value stack[MOST_STACKED];
};

/* Add to the work of a routine, in loop iterations. Return false if the message takes too much: nested loops over long lists
 * could block a thread for hours. */
static inline bool spend(struct machine *machine, size_t work) {
    bool is_enough = work <= machine->work_left;
    machine->work_left = is_enough ? machine->work_left - (uint32_t)work : 0;
    return is_enough;
}

/* Record why a message is refused. Returns false. */
static inline bool machine_refuse(struct machine *machine, struct refusal refusal) {
    machine->refusal = refusal;
    machine->refused.size = 0;
    return false;
}

/* Allocate the memory of a machine. Return false if memory runs out. Close the machine in either case. */
bool machine_open(struct machine *machine);
void machine_close(struct machine *machine);

/* Begin with another message, with this layout: set slots to their defaults, and free cells and text. */
void machine_begin(struct machine *machine, const struct layout *layout);

/* Read a message into the slots. Return false if it is malformed or memory runs out. */
bool machine_read(struct machine *machine, const uint8_t *data, size_t size);

/* The same for a protobuf message in pieces (read_protobuf.h). */
bool machine_read_pieces(struct machine *machine, const uint8_t *data, size_t size);

/* Read the fields of an envelope beside the payload into the slots, if the layout has a section for them. Fails like
 * `machine_read`. OP_PAYLOAD needs it: the datagram must exist until the next begin. */
bool machine_read_envelope(struct machine *machine, const struct datagram *from);

/* Give the slots of a section their defaults, and read an element of a list of messages into them. */
bool machine_enter(struct machine *machine, uint16_t section, const struct value *element);

#endif
