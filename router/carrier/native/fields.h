/* Reads the fields of a payload that a route's topics use into slots, as the protobuf library would parse them: the last
 * of several values counts, messages that come in parts are merged, and a member of a oneof clears the others.
 *
 * router/compiler/lowering says which fields these are. The carrier has checked the payload (envelope.h); what is
 * not well formed all the same is refused. */
#ifndef FIELDS_H
#define FIELDS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "envelope.h"

enum {
    FIRST_CELLS = MAX_DATAGRAM, /* enough for a datagram: each element of a list takes a byte of it at least */
    MOST_NODES_DEEP = 32       /* messages in messages */
};

/* Elements of a repeated field, in cells; of none, `first` means nothing. */
struct list {
    uint32_t first, last;
};

/* An integer or bool, a real number, text or bytes or a message as it was received, or a list. */
struct value {
    union {
        int64_t integer;
        double real;
        const uint8_t *bytes;
        struct list list;
        uint64_t bits;
    };
    uint32_t size; /* bytes, or elements of a list */
    uint32_t reserved;
};

struct cell {
    struct value value;
    uint32_t next, reserved;
};

enum field_type {
    TYPE_BOOL,
    TYPE_INT32, /* enums as well, which are open */
    TYPE_INT64, /* uint64 as well: the same bits */
    TYPE_UINT32,
    TYPE_SINT32,
    TYPE_SINT64,
    TYPE_FIXED32,
    TYPE_SFIXED32,
    TYPE_FIXED64, /* and sfixed64 */
    TYPE_FLOAT,
    TYPE_DOUBLE,
    TYPE_BYTES, /* and string */
    TYPE_MESSAGE,
    TYPE_GROUP /* never wanted, but it may be a member of a oneof */
};
enum { NONE = UINT16_MAX }; /* no such slot or node */

/* A field of a message. */
struct node_field {
    uint32_t number;
    uint8_t type; /* enum field_type */
    uint8_t is_repeated;
    uint16_t slot;     /* of its value or list, or NONE */
    uint16_t presence; /* slot that becomes 1 when it is there, or NONE */
    uint16_t node;     /* of a message that is not repeated, or NONE */
    uint16_t choice;   /* slot with the number of the oneof's member that is there, or NONE */
    uint16_t cleared, cleared_count; /* slots of the oneof's members */
    uint16_t reserved;
};

/* The wanted fields of a message at one place, and all members of their oneofs. */
struct node {
    const struct node_field *fields; /* by ascending number */
    uint32_t count;
    uint16_t first_slot, slot_count; /* of an element of a list: its own, with those of messages in it */
};

struct fields {
    const struct node *nodes;
    const struct value *defaults; /* what slots hold where nothing was read */
    struct value *slots;
    struct cell *cells; /* grows where messages in lists are read more than once */
    uint32_t cell_count, cell_capacity;
};

/* Read a message of `size` bytes into the slots of a node, which have their defaults. */
bool fields_read(struct fields *fields, uint16_t node, const uint8_t *message, size_t size);

/* Give the slots of a node their defaults, and read an element into them. */
bool fields_read_element(struct fields *fields, uint16_t node, const struct value *element);

#endif
