/* A machine for tests, which cannot know the size of its structure, and what it has made. A library of its own. */
#include "evaluate.h"

struct tested {
    struct machine machine;
    uint32_t cell_count; /* behind the message that was read */
    size_t text_size;
};

struct tested *seam_machine_open(void);
void seam_machine_close(struct tested *tested);
bool seam_machine_read(struct tested *tested, const struct layout *layout, const uint8_t *data, size_t size);
int seam_machine_value(struct tested *tested, const struct routine *routine, struct value *value, uint32_t *at);
const struct value *seam_machine_slots(const struct tested *tested);
const struct cell *seam_machine_cells(const struct tested *tested);
const uint8_t *seam_machine_output(const struct tested *tested, size_t *size);

struct tested *seam_machine_open(void) {
    struct tested *tested = malloc(sizeof *tested);
    if (tested && machine_open(&tested->machine)) return tested;
    if (tested) machine_close(&tested->machine);
    free(tested);
    return NULL;
}

void seam_machine_close(struct tested *tested) {
    machine_close(&tested->machine);
    free(tested);
}

bool seam_machine_read(struct tested *tested, const struct layout *layout, const uint8_t *data, size_t size) {
    machine_begin(&tested->machine, layout);
    bool is_read = machine_read(&tested->machine, data, size);
    tested->cell_count = tested->machine.cell_count;
    tested->text_size = tested->machine.text_size;
    return is_read;
}

/* What a program leaves on the stack. It is there until the next call. */
int seam_machine_value(struct tested *tested, const struct routine *routine, struct value *value, uint32_t *at) {
    tested->machine.cell_count = tested->cell_count;
    tested->machine.text_size = tested->text_size;
    return evaluate_list(&tested->machine, routine, value, at);
}

const struct value *seam_machine_slots(const struct tested *tested) { return tested->machine.slots; }
const struct cell *seam_machine_cells(const struct tested *tested) { return tested->machine.cells; }

const uint8_t *seam_machine_output(const struct tested *tested, size_t *size) {
    *size = tested->machine.output.size;
    return tested->machine.output.data;
}
