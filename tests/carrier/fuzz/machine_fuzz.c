/* A libFuzzer target: readers and programs read and write only what they may, whatever a message holds, and a message is
 * made twice in the same way.
 *
 * An input's first two bytes choose a program, the third one whether the rest is a message or, of protobuf, its pieces. */
#include <stdlib.h>
#include <string.h>

#include "envelope.h"
#include "evaluate.h"
#include "events.h"
#include "lists.h"
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
    demand(outcome == EVALUATED || outcome == DROP_MAPPING_ERROR || outcome == DROP_NON_FINITE);
    demand(outcome == EVALUATED || at < count);
    demand(machine.cell_count <= machine.cell_capacity && machine.text_size <= MOST_TEXT);
    demand(machine.output.size <= machine.output.capacity);
}

/* Evaluate a condition and make the message of a target. Return the outcome. */
static int make(const struct fuzzed *chosen) {
    uint32_t at = UINT32_MAX;
    bool is_true;
    if (chosen->condition.count) {
        int outcome = evaluate_condition(&machine, &chosen->condition, &is_true, &at);
        demand_order(outcome, at, chosen->condition.count);
        if (outcome != EVALUATED) return outcome;
    }
    int outcome = evaluate_message(&machine, &chosen->message, &at);
    demand_order(outcome, at, chosen->message.count);
    return outcome;
}

/* Make one for each element of a list. Return the last outcome. */
static int make_for_each(const struct fuzzed *chosen) {
    uint32_t at = UINT32_MAX, cell_count;
    struct value list;
    int outcome = evaluate_list(&machine, &chosen->list, &list, &at);
    demand_order(outcome, at, chosen->list.count);
    if (outcome != EVALUATED) return outcome;
    for (cell_count = machine.cell_count; list.size; machine.cell_count = cell_count) {
        struct value element = list_next(&machine, &list, chosen->stored);
        if (chosen->section == NONE) machine.slots[chosen->item] = element;
        else if (!machine_enter(&machine, chosen->section, &element)) return DROP_MAPPING_ERROR;
        outcome = make(chosen);
    }
    return outcome;
}

/* Read and evaluate as the threads do. Return the outcome. */
static int run(const struct fuzzed *chosen, bool is_in_pieces, const uint8_t *data, size_t size) {
    machine.output.size = 0;
    machine_begin(&machine, &chosen->layout);
    memset(machine.slots + chosen->layout.slot_count, 0xa5, sizeof *machine.slots); /* nobody is to use it */
    machine.slots[RECEIVED_AT].integer = 1700000000123456789;
    machine.slots[SOURCE] = (struct value){.bytes = (const uint8_t *)"a board", .size = 7};
    if (!(is_in_pieces ? machine_read_pieces : machine_read)(&machine, data, size)) return DROP_MAPPING_ERROR;
    return chosen->list.count ? make_for_each(chosen) : make(chosen);
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    if (size < 3 || size > MAX_DATAGRAM) return -1;
    const struct fuzzed *chosen = &programs[(input[0] + 256 * input[1]) % PROGRAM_COUNT];
    bool is_in_pieces = input[2] % 2 && !chosen->layout.is_cdr;
    size -= 3;
    uint8_t *data = malloc(size ? size : 1); /* of the exact size: the sanitizer sees what is read behind it */
    memcpy(data, input + 3, size);
    int outcome = run(chosen, is_in_pieces, data, size);
    note_outcome(&outcome, sizeof outcome);
    if (outcome == EVALUATED) {
        size_t made = machine.output.size;
        note_outcome(machine.output.data, made);
        uint8_t *first = malloc(made ? made : 1);
        memcpy(first, machine.output.data, made);
        demand(run(chosen, is_in_pieces, data, size) == EVALUATED && machine.output.size == made);
        demand(!memcmp(first, machine.output.data, made));
        free(first);
    }
    free(data);
    return 0;
}
