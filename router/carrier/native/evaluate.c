#include "evaluate.h"

#include <math.h>

#include "arithmetic.h"
#include "deliver.h"
#include "events.h"
#include "lists.h"
#include "payload.h"
#include "state_value.h"
#include "texts.h"
#include "utf8.h"
#include "write_cdr.h"
#include "write_protobuf.h"

/* ---- states ---- */

/* Read the present value of a state into a slot. Return false if there is no room for a text. */
static bool present_state(struct machine *machine, int64_t index, struct value *slot) {
    const struct state_settings *settings = &machine->layout->states[index];
    int64_t now = machine->env->now(machine->env);
    if (!settings->is_text) {
        slot->integer = state_number(settings, now);
        return true;
    }
    struct state_content content;
    uint8_t *text = take_text(machine, MOST_STATE_TEXT);
    if (!text) return false;
    state_value(settings, now, &content);
    *slot = text_of(memcpy(text, content.text, MOST_STATE_TEXT), (size_t)content.number);
    return true;
}

/* ---- lists ---- */

/* Make a list in cells from `size` values, beginning with `first`. */
static bool collect(struct machine *machine, const struct value *first, uint32_t size, struct value *list) {
    struct value made = {.size = 0};
    for (uint32_t index = 0; index < size; index++)
        if (!list_add(machine, &made, first[index])) return false;
    *list = made;
    return true;
}

static bool unpack(struct machine *machine, struct value *list, enum scalar stored) {
    struct value made = {.size = 0};
    while (list->size)
        if (!list_add(machine, &made, list_next(machine, list, stored))) return false;
    *list = made;
    return true;
}

/* ---- payloads ---- */

static bool append_payload(struct output *output, const struct datagram *from) {
    if (!has_room(output, from->length)) return false;
    output->size += write_payload(from, output->data + output->size);
    return true;
}

/* ---- refusals ---- */

static struct refusal two(enum refused kind, int64_t first, int64_t second) {
    return (struct refusal){.kind = kind, .values = {first, second}};
}

static struct refusal real(enum refused kind, double number) {
    return (struct refusal){.kind = kind, .flags = 1, .values = {(int64_t)float64_bits(number)}};
}

/* The refusal of an operation, whose operands are at `top` and after it. */
static struct refusal refusal_of(const struct operation *op, const struct value *top) {
    switch ((enum op)op->kind) {
    case OP_CHECKED_ADD:
    case OP_CHECKED_SUBTRACT:
    case OP_CHECKED_MULTIPLY:
    case OP_CHECKED_NEGATE: return (struct refusal){.kind = REFUSED_OVERFLOW};
    case OP_DIVIDE:
    case OP_MODULO: return (struct refusal){.kind = top[1].bits ? REFUSED_OVERFLOW : REFUSED_DIVISION};
    case OP_REAL_DIVIDE:
    case OP_REAL_FLOOR_DIVIDE:
    case OP_REAL_MODULO: return (struct refusal){.kind = REFUSED_DIVISION};
    case OP_FIT: return (struct refusal){REFUSED_INTEGER, op->flag, {top[0].integer, top[1].integer, top[2].integer}};
    case OP_WRAP: return (struct refusal){REFUSED_BOUNDS, op->flag, {0, top[1].integer, top[2].integer}};
    case OP_REAL_POWER: return (struct refusal){.kind = REFUSED_RESULT};
    case OP_SQRT:
    case OP_SIN:
    case OP_COS:
    case OP_TAN: return real(REFUSED_RESULT, top->real);
    case OP_ROUND:
    case OP_TRUNCATE:
    case OP_FLOOR:
    case OP_CEIL: return real(REFUSED_REAL, top->real);
    case OP_FLOAT32: return real(REFUSED_FLOAT32, top->real);
    case OP_PUT_FLOAT:
    case OP_WRITE_FLOAT:
        if (!fits_float32(top[1].real)) return real(REFUSED_FLOAT32, top[1].real);
        break;
    case OP_FIT_SIZE: return two(REFUSED_SIZE, top->size, op->integer);
    case OP_UTF8: return two(REFUSED_UTF8, top->size, 0);
    case OP_NAMELESS: return two(REFUSED_NAME, top->size, 0);
    case OP_PUT_TEXT:
        if (has_nul(top + 1)) return two(REFUSED_NUL, top[1].size, 0);
        break;
    case OP_MEMBER: return two(REFUSED_MEMBER, top->integer, 0);
    case OP_ELEMENT: return two(REFUSED_ELEMENT, op->integer, top->size);
    case OP_FIT_COUNT: return two(op->flag ? REFUSED_MOST : REFUSED_COUNT, top->integer, op->integer);
    case OP_SAME_COUNT: return two(REFUSED_LENGTHS, top[0].integer, top[1].integer);
    case OP_AGAIN: return (struct refusal){.kind = REFUSED_WORK};
    default: break;
    }
    return (struct refusal){.kind = REFUSED_ROOM};
}

/* Record the refusal of an operation, unless a function that it called has already done so. */
static void explain(struct machine *machine, const struct operation *op, const struct value *top) {
    if (op->kind == OP_ENTER || op->kind == OP_OCTETS) return;
    machine_refuse(machine, refusal_of(op, top));
    switch (machine->refusal.kind) {
    case REFUSED_UTF8:
    case REFUSED_NAME: machine->refused = top[0]; break;
    case REFUSED_NUL: machine->refused = top[1]; break;
    default: break;
    }
}

static int outcome_of(const struct refusal *refusal) {
    bool is_finite = refusal->kind != REFUSED_REAL || isfinite(of_float64((uint64_t)refusal->values[0]));
    return is_finite ? DROP_MAPPING_ERROR : DROP_NON_FINITE;
}

/* ---- execution ---- */

struct loop {
    const struct operation *repeat;
    int64_t left; /* iterations, including this one */
    uint32_t cell_count;
    size_t text_size;
};

/* Free the cells and text of an iteration, unless they are kept. */
static void end_turn(struct machine *machine, const struct loop *loop) {
    if (loop->repeat->flag) return;
    machine->cell_count = loop->cell_count;
    machine->text_size = loop->text_size;
}

/* These end a case: the operation refuses the message unless the condition is true. */
#define WANT(condition)             \
    if (!(condition)) goto refused; \
    break

/* Apply a function of one real number, which is kept if the function has no result. */
#define FUNCTION(function)                   \
    {                                        \
        double of = top->real;               \
        top->real = function(of);            \
        if (is_result(top->real, of)) break; \
        top->real = of;                      \
        goto refused;                        \
    }

/* Convert a real number to the integer that `function` rounds it to. */
#define ROUNDED(function)                   \
    if (!isfinite(top->real)) goto refused; \
    top->real = function(top->real);        \
    WANT(to_integer(top))

/* Execute operations. The second value of the stack is their result. */
static int execute(struct machine *machine, const struct routine *routine, uint32_t *at) {
    const struct operation *operations = routine->operations;
    const uint8_t *literals = machine->layout->literals;
    struct value *slots = machine->slots;
    struct output *output = &machine->output;
    struct value *top = machine->stack; /* the first value is never used; `top[1]` is the value that an operation has popped */
    const struct operation *op = operations, *end = op + routine->count;
    struct loop loops[MOST_LOOPS + 1], *loop = loops; /* the first one is never used either */
    struct opened opened[MOST_OPEN + 1], *open = opened;
    for (; op < end; op++) {
        switch ((enum op)op->kind) {
        case OP_INTEGER: (++top)->integer = op->integer; break;
        case OP_REAL: (++top)->real = op->real; break;
        case OP_TEXT: *++top = text_of(literals + op->integer, op->size); break;
        case OP_LOAD: *++top = slots[op->slot]; break;
        case OP_KEEP: slots[op->slot] = *top; break;
        case OP_DROP: top--; break;
        case OP_STATE: WANT(present_state(machine, op->integer, &slots[op->slot]));

        case OP_ADD: top--; top->bits += top[1].bits; break;
        case OP_SUBTRACT: top--; top->bits -= top[1].bits; break;
        case OP_MULTIPLY: top--; top->bits *= top[1].bits; break;
        case OP_CHECKED_ADD: top--; WANT(checked_add(top, top + 1, op->flag));
        case OP_CHECKED_SUBTRACT: top--; WANT(checked_subtract(top, top + 1, op->flag));
        case OP_CHECKED_MULTIPLY: top--; WANT(checked_multiply(top, top + 1, op->flag));
        case OP_CHECKED_NEGATE: WANT(checked_negate(top, op->flag));
        case OP_NEGATE: top->bits = -top->bits; break;
        case OP_ABSOLUTE: if (top->integer < 0) top->bits = -top->bits; break;
        case OP_DIVIDE: top--; WANT(divide(top, top + 1, op->flag));
        case OP_MODULO: top--; WANT(modulo(top, top + 1, op->flag));
        case OP_LEAST: top--; if (!is_less(top, top + 1, op->flag)) *top = top[1]; break;
        case OP_GREATEST: top--; if (is_less(top, top + 1, op->flag)) *top = top[1]; break;
        case OP_CLAMP:
            top -= 2;
            if (is_below(top, op->flag)) *top = top[1];
            else if (is_above(top, op->flag)) *top = top[2];
            break;
        case OP_FIT: top -= 2; WANT(!is_below(top, op->flag) && !is_above(top, op->flag));
        case OP_WRAP: top -= 2; WANT(wrap(top, op->flag));

        case OP_REAL_ADD: top--; top->real += top[1].real; break;
        case OP_REAL_SUBTRACT: top--; top->real -= top[1].real; break;
        case OP_REAL_MULTIPLY: top--; top->real *= top[1].real; break;
        case OP_REAL_DIVIDE: top--; top->real /= top[1].real; WANT(top[1].real != 0);
        case OP_REAL_FLOOR_DIVIDE: top--; top->real = real_floor_divide(top->real, top[1].real); WANT(top[1].real != 0);
        case OP_REAL_MODULO: top--; top->real = real_modulo(top->real, top[1].real); WANT(top[1].real != 0);
        case OP_REAL_POWER: top--; WANT(power(&top->real, top[1].real));
        case OP_REAL_NEGATE: top->real = -top->real; break;
        case OP_REAL_ABSOLUTE: top->real = fabs(top->real); break;
        case OP_REAL_LEAST: top--; if (top[1].real < top->real) *top = top[1]; break;
        case OP_REAL_GREATEST: top--; if (top[1].real > top->real) *top = top[1]; break;
        case OP_REAL_CLAMP: top -= 2; top->real = real_clamp(top->real, top[1].real, top[2].real); break;
        case OP_SQRT: FUNCTION(sqrt)
        case OP_SIN: FUNCTION(sin)
        case OP_COS: FUNCTION(cos)
        case OP_TAN: FUNCTION(tan)
        case OP_ATAN2: top--; top->real = angle(top->real, top[1].real); break;
        case OP_HYPOT: top--; top->real = length(top->real, top[1].real); break;
        case OP_FLOAT32: WANT(fits_float32(top->real));

        case OP_INTEGER_TO_REAL: top->real = op->flag ? (double)top->bits : (double)top->integer; break;
        case OP_ROUND: ROUNDED(nearbyint);
        case OP_TRUNCATE: ROUNDED(trunc);
        case OP_FLOOR: ROUNDED(floor);
        case OP_CEIL: ROUNDED(ceil);

        case OP_COMPARE: top--; top->integer = compare(op->flag, op->slot, top, top + 1); break;
        case OP_NOT: top->integer = !top->integer; break;
        case OP_JUMP: op += op->size; break;
        case OP_UNLESS: top--; if (!top[1].integer) op += op->size; break;
        case OP_AND: if (!top->integer) op += op->size; else top--; break;
        case OP_OR: if (top->integer) op += op->size; else top--; break;
        case OP_EITHER: top--; top->integer |= top[1].integer; break;

        case OP_JOIN: top--; WANT(join(machine, top, top + 1));
        case OP_DECIMAL: WANT(to_decimal(machine, top, op->flag));
        case OP_DIGITS: WANT(to_digits(machine, top, op->slot));
        case OP_CHARACTERS: top->integer = characters(top); break;
        case OP_SIZE: top->integer = top->size; break;
        case OP_FIT_SIZE: WANT(top->size <= op->integer);
        case OP_STRIP: strip(top); break;
        case OP_UTF8: WANT(is_utf8(top->bytes, top->size));
        case OP_NAMELESS: goto refused;
        case OP_OCTETS: WANT(to_octets(machine, top, op->flag));
        case OP_MEMBER: WANT(is_among(top->integer, literals + op->integer, op->size));

        case OP_FIT_COUNT: WANT(top->integer == op->integer || (op->flag && top->integer < op->integer));
        case OP_SAME_COUNT: top--; WANT(top[0].integer == top[1].integer);
        case OP_ELEMENT: WANT(list_element(machine, top, op->flag, op->integer, top));
        case OP_ENTER: top--; WANT(machine_enter(machine, op->slot, top + 1));
        case OP_REPEAT:
            top--;
            if (top[1].integer > 0)
                *++loop = (struct loop){op, top[1].integer, machine->cell_count, machine->text_size};
            else op += op->size;
            break;
        case OP_AGAIN:
            end_turn(machine, loop);
            if (--loop->left) op = loop->repeat;
            else loop--;
            WANT(spend(machine, 1));
        case OP_NEXT: *++top = list_next(machine, &slots[op->slot], op->flag); break;
        case OP_LIST: top -= op->size; top++; WANT(collect(machine, top, op->size, top));
        case OP_UNPACK: WANT(unpack(machine, top, op->flag));
        case OP_APPEND: top--; WANT(list_add(machine, &slots[op->slot], top[1]));

        case OP_KNOWN: WANT(put(output, literals + op->integer, op->size, op->slot));
        case OP_PUT: top--; WANT(put_integer(output, top[1].bits, op->slot));
        case OP_PUT_FLOAT: top--; WANT(put_float(output, top[1].real));
        case OP_PUT_DOUBLE: top--; WANT(put_double(output, top[1].real));
        case OP_PUT_TEXT: top--; WANT(put_text(output, top + 1));
        case OP_PUT_BYTES: top--; WANT(append(output, top[1].bytes, top[1].size));

        case OP_OPEN: WANT(write_open(output, op->size, op->flag, ++open));
        case OP_CLOSE: WANT(write_close(output, open--));
        case OP_WRITE_VARINT: top--; WANT(write_varint(output, op->size, top[1].bits, op->flag));
        case OP_WRITE_ZIGZAG: top--; WANT(write_varint(output, op->size, to_zigzag(top[1].bits), op->flag));
        case OP_WRITE_FIXED32: top--; WANT(write_fixed(output, op->size, (uint32_t)top[1].bits, 4, op->flag));
        case OP_WRITE_FIXED64: top--; WANT(write_fixed(output, op->size, top[1].bits, 8, op->flag));
        case OP_WRITE_FLOAT:
            top--;
            WANT(fits_float32(top[1].real) && write_fixed(output, op->size, float32_bits(top[1].real), 4, op->flag));
        case OP_WRITE_DOUBLE: top--; WANT(write_fixed(output, op->size, float64_bits(top[1].real), 8, op->flag));
        case OP_WRITE_BYTES: top--; WANT(write_bytes(output, op->size, top + 1, op->flag));
        case OP_PAYLOAD: WANT(append_payload(output, machine->datagram));
        }
    }
    return EVALUATED;
refused:
    *at = (uint32_t)(op - operations);
    explain(machine, op, top);
    return outcome_of(&machine->refusal);
}

int evaluate_list(struct machine *machine, const struct routine *routine, struct value *list, uint32_t *at) {
    int outcome = execute(machine, routine, at);
    *list = machine->stack[1];
    return outcome;
}

/* Execute a routine, and free its cells and text. */
static int run(struct machine *machine, const struct routine *routine, uint32_t *at) {
    uint32_t cell_count = machine->cell_count;
    size_t text_size = machine->text_size;
    int outcome = execute(machine, routine, at);
    machine->cell_count = cell_count;
    machine->text_size = text_size;
    return outcome;
}

int evaluate_value(struct machine *machine, const struct routine *routine, struct value *value, uint32_t *at) {
    int outcome = run(machine, routine, at);
    *value = machine->stack[1];
    return outcome;
}

int evaluate_condition(struct machine *machine, const struct routine *routine, bool *is_true, uint32_t *at) {
    int outcome = run(machine, routine, at);
    *is_true = machine->stack[1].integer;
    return outcome;
}

int evaluate_message(struct machine *machine, const struct routine *routine, uint32_t *at) {
    machine->output.size = 0;
    return run(machine, routine, at);
}
