#include "machine.h"

#include <stdlib.h>
#include <string.h>

#include "deliver.h"
#include "read_cdr.h"
#include "read_protobuf.h"

enum { FIRST_CAPACITY = 4096 };

bool machine_open(struct machine *machine) {
    memset(machine, 0, sizeof *machine);
    machine->slots = calloc(UINT16_MAX + 1, sizeof *machine->slots);
    machine->cells = malloc(FIRST_CELLS * sizeof *machine->cells);
    machine->cell_capacity = FIRST_CELLS;
    machine->text = malloc(MOST_TEXT);
    machine->output.data = malloc(FIRST_CAPACITY);
    machine->output.capacity = FIRST_CAPACITY;
    return machine->slots && machine->cells && machine->text && machine->output.data;
}

void machine_close(struct machine *machine) {
    free(machine->slots);
    free(machine->cells);
    free(machine->text);
    free(machine->output.data);
}

void machine_begin(struct machine *machine, const struct layout *layout) {
    machine->layout = layout;
    machine->cell_count = 0;
    machine->text_size = 0;
    machine->work_left = MOST_WORK;
    memcpy(machine->slots, layout->defaults, layout->slot_count * sizeof *machine->slots);
}

static bool check_read(struct machine *machine, bool is_read) {
    return is_read || machine_refuse(machine, (struct refusal){.kind = REFUSED_MALFORMED});
}

bool machine_read(struct machine *machine, const uint8_t *data, size_t size) {
    bool is_cdr = machine->layout->is_cdr;
    return check_read(machine, is_cdr ? read_cdr(machine, 0, data, size) : read_protobuf(machine, 0, data, size));
}

bool machine_read_pieces(struct machine *machine, const uint8_t *data, size_t size) {
    return check_read(machine, read_protobuf_pieces(machine, 0, data, size));
}

bool machine_read_envelope(struct machine *machine, const struct datagram *from) {
    uint16_t envelope = machine->layout->envelope;
    if (!envelope) return true;
    machine->datagram = from;
    return check_read(machine, read_protobuf(machine, envelope, from->data, from->size));
}

bool machine_enter(struct machine *machine, uint16_t section, const struct value *element) {
    const struct layout *layout = machine->layout;
    const struct section *of = &layout->sections[section];
    memcpy(machine->slots + of->first_slot, layout->defaults + of->first_slot, of->slot_count * sizeof *machine->slots);
    return check_read(machine, layout->is_cdr ? read_cdr_element(machine, section, element->bytes)
                                              : read_protobuf(machine, section, element->bytes, element->size));
}
