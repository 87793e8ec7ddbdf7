/* Runs routines on the message that a machine has read: conditions, and messages for targets. */
#ifndef EVALUATE_H
#define EVALUATE_H

#include <stdbool.h>
#include <stdint.h>

#include "machine.h"

enum { EVALUATED = -1 };

/* These return EVALUATED, or why the message is refused, an enum drop_reason (events.h); `at` is then the index of the
 * operation that refused it. Cells and text of a routine are freed when it ends. */

/* Evaluate a condition. */
int evaluate_condition(struct machine *machine, const struct routine *routine, bool *is_true, uint32_t *at);

/* Evaluate a number or a text, which is valid until another routine runs. */
int evaluate_value(struct machine *machine, const struct routine *routine, struct value *value, uint32_t *at);

/* Write the message of a routine to the machine's output. If it is refused, the output is not valid. */
int evaluate_message(struct machine *machine, const struct routine *routine, uint32_t *at);

/* Evaluate the list of `for_each`. Its cells and text are valid until the next machine_begin. */
int evaluate_list(struct machine *machine, const struct routine *routine, struct value *list, uint32_t *at);

#endif
