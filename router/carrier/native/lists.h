/* A list is stored in one of two ways: as an array of scalars, which stays in the CDR message, or as a chain of cells. Lists
 * from protobuf and computed lists are in cells. */
#ifndef LISTS_H
#define LISTS_H

#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>

#include "machine.h"
#include "numbers.h"

/* The size in bytes of a scalar in CDR, which is also its alignment. */
static inline unsigned scalar_size(enum scalar type) {
    static const uint8_t SIZES[] = {1, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8};
    return SIZES[type];
}

static inline struct value scalar_load(const uint8_t *from, enum scalar type) {
    switch (type) {
    case SCALAR_BOOL: return (struct value){.integer = *from != 0};
    case SCALAR_INT8: return (struct value){.integer = (int8_t)*from};
    case SCALAR_UINT8: return (struct value){.integer = *from};
    case SCALAR_INT16: return (struct value){.integer = (int16_t)load_little_endian(from, 2)};
    case SCALAR_UINT16: return (struct value){.integer = (int64_t)load_little_endian(from, 2)};
    case SCALAR_INT32: return (struct value){.integer = (int32_t)load_little_endian(from, 4)};
    case SCALAR_UINT32: return (struct value){.integer = (int64_t)load_little_endian(from, 4)};
    case SCALAR_FLOAT32: return (struct value){.real = of_float32(load_little_endian(from, 4))};
    case SCALAR_FLOAT64: return (struct value){.real = of_float64(load_little_endian(from, 8))};
    default: return (struct value){.bits = load_little_endian(from, 8)};
    }
}

static inline bool has_cell(struct machine *machine) {
    if (machine->cell_count < machine->cell_capacity) return true;
    uint32_t capacity = 2 * machine->cell_capacity;
    if (capacity > MOST_CELLS) return false;
    struct cell *cells = realloc(machine->cells, capacity * sizeof *cells);
    if (!cells) return false;
    machine->cells = cells;
    machine->cell_capacity = capacity;
    return true;
}

/* Add an element to a list in cells. Return false if the cells are used up. */
static inline bool list_add(struct machine *machine, struct value *list, struct value element) {
    if (!has_cell(machine)) return false;
    uint32_t index = machine->cell_count++;
    machine->cells[index].value = element;
    if (list->size++) machine->cells[list->list.last].next = index;
    else list->list.first = index;
    list->list.last = index;
    return true;
}

/* Remove and return the first element of a list that is not empty. */
static inline struct value list_next(const struct machine *machine, struct value *list, enum scalar stored) {
    list->size--;
    if (stored == IN_CELLS) {
        const struct cell *cell = &machine->cells[list->list.first];
        list->list.first = cell->next; /* has no meaning after the last cell */
        return cell->value;
    }
    struct value element = scalar_load(list->bytes, stored);
    list->bytes += scalar_size(stored);
    return element;
}

/* Find an element by its index. Return false if there is none. */
static inline bool list_element(const struct machine *machine, const struct value *list, enum scalar stored, int64_t index,
                                struct value *element) {
    if (index >= list->size) return false;
    if (stored != IN_CELLS) {
        *element = scalar_load(list->bytes + (size_t)index * scalar_size(stored), stored);
        return true;
    }
    uint32_t at = list->list.first;
    for (; index; index--) at = machine->cells[at].next;
    *element = machine->cells[at].value;
    return true;
}

#endif
