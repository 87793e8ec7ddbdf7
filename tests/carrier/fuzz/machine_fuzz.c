/* A libFuzzer target: readers and programs read and write only what they may, whatever a message holds, and a message is
 * made twice in the same way.
 *
 * An input's first two bytes choose a program, the third one whether the rest is a payload or an envelope, if there is one
 * around it. */
#include <stdlib.h>
#include <string.h>

#include "envelope.h"
#include "evaluate.h"
#include "events.h"
#include "outcome.h"
#include "programs.h"

enum { RECEIVED_AT, SOURCE };

static struct machine machine;

static void demand(bool condition) {
    if (!condition) abort();
}

int LLVMFuzzerInitialize(int *count, char ***arguments);
int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);

int LLVMFuzzerInitialize(int *count, char ***arguments) {
    (void)count, (void)arguments;
    demand(machine_open(&machine));
    return 0;
}

static void demand_order(int outcome, uint32_t at, uint32_t count) {
    demand(outcome == EVALUATED || outcome == LOSS_MAPPING_ERROR || outcome == LOSS_NON_FINITE);
    demand(outcome == EVALUATED || at < count);
    demand(machine.cell_count <= machine.cell_capacity && machine.text_size <= MOST_TEXT);
    demand(machine.output.size <= machine.output.capacity);
}

/* Read and evaluate as the threads do. Return the outcome. */
static int run(const struct fuzzed *chosen, uint16_t node, const uint8_t *data, size_t size) {
    uint32_t at = UINT32_MAX, slot_count = chosen->layout.slot_count;
    bool is_true;
    machine_begin(&machine, &chosen->layout);
    memset(machine.slots + slot_count, 0xa5, sizeof *machine.slots); /* behind them, nothing is to be used */
    machine.slots[RECEIVED_AT].integer = 1700000000123456789;
    machine.slots[SOURCE] = (struct value){.bytes = (const uint8_t *)"a board", .size = 7};
    if (!machine_read(&machine, node, data, size)) return LOSS_MAPPING_ERROR;
    int outcome = EVALUATED;
    if (chosen->condition.count) outcome = evaluate_condition(&machine, &chosen->condition, &is_true, &at);
    demand_order(outcome, at, chosen->condition.count);
    if (outcome != EVALUATED) return outcome;
    outcome = evaluate_message(&machine, &chosen->message, &at);
    demand_order(outcome, at, chosen->message.count);
    return outcome;
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    if (size < 3 || size > MAX_DATAGRAM) return -1;
    const struct fuzzed *chosen = &programs[(input[0] + 256 * input[1]) % PROGRAM_COUNT];
    uint16_t node = input[2] % 2 && chosen->has_envelope;
    size -= 3;
    uint8_t *data = malloc(size ? size : 1); /* of the exact size: the sanitizer sees what is read behind it */
    memcpy(data, input + 3, size);
    int outcome = run(chosen, node, data, size);
    note_outcome(&outcome, sizeof outcome);
    if (outcome == EVALUATED) {
        size_t made = machine.output.size;
        note_outcome(machine.output.data, made);
        uint8_t *first = malloc(made ? made : 1);
        memcpy(first, machine.output.data, made);
        demand(run(chosen, node, data, size) == EVALUATED && machine.output.size == made);
        demand(!memcmp(first, machine.output.data, made));
        free(first);
    }
    free(data);
    return 0;
}
