/* Runs programs on what a machine has read: conditions, and messages for targets. */
#ifndef EVALUATE_H
#define EVALUATE_H

#include <stdbool.h>
#include <stdint.h>

#include "machine.h"

enum { EVALUATED = -1 };

/* These return EVALUATED, or why the message is refused, an enum loss (events.h). `at` is then the index of the operation
 * that refused. Cells and text that a program takes are free again behind it. */

/* Evaluate a condition. */
int evaluate_condition(struct machine *machine, const struct code *code, bool *is_true, uint32_t *at);

/* Write the message that a program makes to the machine's output, which is void if it is refused. */
int evaluate_message(struct machine *machine, const struct code *code, uint32_t *at);

/* Evaluate the list of `for_each`. What it takes of cells and text stays until the next machine_begin. */
int evaluate_list(struct machine *machine, const struct code *code, struct value *list, uint32_t *at);

#endif
