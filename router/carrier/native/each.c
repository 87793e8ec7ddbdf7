#include "each.h"

#include "evaluate.h"
#include "lists.h"

bool each_begin(struct machine *machine, const struct for_each *each, struct message *message, struct value *list) {
    uint32_t at;
    message->place = PLACE_FOR_EACH;
    message->outcome = evaluate_list(machine, &each->list, list, &at);
    if (message->outcome == EVALUATED && list->size > MOST_ELEMENTS) {
        machine_refuse(machine, (struct refusal){.kind = REFUSED_MOST, .values = {list->size, MOST_ELEMENTS}});
        message->outcome = DROP_MAPPING_ERROR;
    }
    if (message->outcome != EVALUATED) return false;
    if (each->count != NONE) machine->slots[each->count].integer = list->size;
    return true;
}

void each_next(struct machine *machine, const struct for_each *each, struct message *message, struct value *list,
               int64_t index) {
    struct value item = list_next(machine, list, each->stored);
    message->outcome = EVALUATED;
    if (each->index != NONE) machine->slots[each->index].integer = index;
    if (each->section == NONE) machine->slots[each->item] = item;
    else if (!machine_enter(machine, each->section, &item)) message->outcome = DROP_MAPPING_ERROR;
}

/* The elements after the first are counted as split, one by one: so the counters balance whenever the lock is released. */
static bool deliver_elements(struct thread_env *env, const struct targets *to, const struct target *target,
                             struct message element, struct value list) {
    struct machine *machine = &env->machine;
    for (int64_t index = 0; list.size; index++) {
        uint32_t cell_count = machine->cell_count;
        if (index) env_count(env, target->split, 1);
        each_next(machine, target->for_each, &element, &list, index);
        if (!deliver(env, to, target, &element)) return false;
        machine->cell_count = cell_count;
    }
    return true;
}

bool deliver_each(struct thread_env *env, const struct targets *to, const struct target *target, struct message *message) {
    if (!deliver_begin(env, to, target, message)) return true;
    struct machine *machine = &env->machine;
    struct message element = *message;
    struct value list;
    uint32_t cell_count = machine->cell_count;
    size_t text_size = machine->text_size;
    bool goes_on = true;
    if (!each_begin(machine, target->for_each, &element, &list)) goes_on = deliver(env, to, target, &element);
    else if (!list.size) env_count(env, target->filtered, 1);
    else goes_on = deliver_elements(env, to, target, element, list);
    machine->cell_count = cell_count;
    machine->text_size = text_size;
    return goes_on;
}
