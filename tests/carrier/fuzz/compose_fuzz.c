/* A libFuzzer target: `fields_read` and the programs of topics read and write only what they may, whatever a payload or
 * an envelope holds, and a message is made twice in the same way.
 *
 * An input's first byte chooses a program, the second one whether the rest is a payload or an envelope. */
#include <stdlib.h>
#include <string.h>

#include "compose.h"
#include "publishing.h"
#include "compositions.h"
#include "outcome.h"

static struct composer composer;

static void demand(bool condition) {
    if (!condition) abort();
}

int LLVMFuzzerInitialize(int *count, char ***arguments);
int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);

int LLVMFuzzerInitialize(int *count, char ***arguments) {
    (void)count, (void)arguments;
    demand(composer_open(&composer));
    return 0;
}

/* Read and compose as the thread does. Return the outcome. */
static int run(const struct composition *chosen, bool is_envelope, const uint8_t *data, size_t size) {
    struct fields *fields = &composer.fields;
    uint32_t at = UINT32_MAX;
    bool is_true = true;
    fields->nodes = chosen->nodes;
    fields->defaults = chosen->defaults;
    fields->cell_count = 0;
    memcpy(fields->slots, chosen->defaults, chosen->slot_count * sizeof *fields->slots);
    memset(fields->slots + chosen->slot_count, 0xa5, sizeof *fields->slots); /* behind them, nothing is to be used */
    fields->slots[SLOT_RECEIVED_AT].integer = 1700000000123456789;
    fields->slots[SLOT_SOURCE] = (struct value){.bytes = (const uint8_t *)"a board", .size = 7};
    composer.literals = chosen->literals;
    if (!fields_read(fields, is_envelope ? NODE_ENVELOPE : NODE_PAYLOAD, data, size)) return LOSS_MAPPING_ERROR;
    demand(fields->cell_count <= fields->cell_capacity);
    if (chosen->condition_count) {
        int outcome = compose_condition(&composer, chosen->condition, chosen->condition_count, &is_true, &at);
        if (outcome != COMPOSED) return outcome;
    }
    int outcome = compose(&composer, chosen->operations, chosen->operation_count, &at);
    demand(outcome == COMPOSED ? composer.message.size >= 4 : at < chosen->operation_count);
    demand(composer.message.size <= composer.message.capacity && composer.text_size <= MOST_TEXT);
    return outcome;
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    if (size < 2 || size > MAX_DATAGRAM) return -1;
    const struct composition *chosen = &compositions[input[0] % COMPOSITION_COUNT];
    bool is_envelope = input[1] % 2;
    size -= 2;
    uint8_t *data = malloc(size ? size : 1); /* of the exact size: the sanitizer sees what is read behind it */
    memcpy(data, input + 2, size);
    int outcome = run(chosen, is_envelope, data, size);
    demand(outcome == COMPOSED || outcome == LOSS_MAPPING_ERROR || outcome == LOSS_NON_FINITE);
    note_outcome(&outcome, sizeof outcome);
    if (outcome == COMPOSED) {
        note_outcome(composer.message.data, composer.message.size);
        size_t made = composer.message.size;
        uint8_t *first = malloc(made);
        memcpy(first, composer.message.data, made);
        demand(run(chosen, is_envelope, data, size) == COMPOSED && composer.message.size == made);
        demand(!memcmp(first, composer.message.data, made));
        free(first);
    }
    free(data);
    return 0;
}
