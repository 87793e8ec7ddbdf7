/* `for_each`: each element of a list in a message is delivered like a message. */
#ifndef EACH_H
#define EACH_H

#include <stdbool.h>
#include <stdint.h>

#include "deliver.h"

enum { MOST_ELEMENTS = 1 << 16 /* of one message, as a lock is held meanwhile */ };

struct for_each {
    struct routine list;   /* leaves the list on the stack; empty without `for_each` */
    uint16_t stored;       /* how the list is stored: enum scalar */
    uint16_t section;      /* for an element that is a message, or NONE */
    uint16_t item;         /* slot for any other element */
    uint16_t index, count; /* slots, or NONE if unused */
    uint16_t reserved[3];
};

/* Evaluate the list of a message that was read. If it is refused, or too long, return false, and the message has the outcome. */
bool each_begin(struct machine *machine, const struct for_each *each, struct message *message, struct value *list);

/* Remove the first element from the list, and make `message` that element. */
void each_next(struct machine *machine, const struct for_each *each, struct message *message, struct value *list, int64_t index);

/* Deliver each element of a datagram's list to a topic. If the datagram as a whole is not wanted, refused or stale, or the
 * list is empty, that counts as one message. Return false if the thread was abandoned. */
bool deliver_each(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message);

#endif
