/* A libFuzzer target: whatever datagrams say of themselves, frames have the parts that were sent, what is held stays within
 * its limits, and the counters balance. Each four bytes of an input are some datagrams in a row. */
#include "collect.c"

enum { BY = 2, COUNT, PLACE, ITEMS, COUNTED, SLOTS };
enum { FILTERED, COLLECTED, INCOMPLETE, REFUSED, COUNTERS };
static const int64_t TIMEOUT = 1000000000;

int LLVMFuzzerInitialize(int *count, char ***arguments);
int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);

#define FIELD(of, in) {.number = of, .type = TYPE_INT64, .slot = in, .presence = NONE, .section = NONE, .choice = NONE, .closed = NONE}
static const struct wanted_field fields[] = {FIELD(1, BY), FIELD(2, COUNT), FIELD(3, PLACE)};
static const struct section sections[] = {{.fields = fields, .count = 3}};
static const struct value defaults[SLOTS], sources[2];
static const struct layout layout = {.sections = sections, .defaults = defaults, .slot_count = SLOTS};
#define LOADS(name, from) static const struct operation name[] = {{.kind = OP_LOAD, .slot = from}}
LOADS(by, BY);
LOADS(count, COUNT);
LOADS(place, PLACE);
static const uint32_t senders[] = {7, 9};
static struct collect collects = {.by = {by, 1, 0}, .count = {count, 1, 0}, .order = {place, 1, 0}, .senders = senders,
                                  .signs = FIRST_UNSIGNED | SECOND_UNSIGNED, .items = ITEMS, .counted = COUNTED};
static const struct target only = {.filtered = FILTERED, .collected = COLLECTED,
                                   .dropped = {[DROP_INCOMPLETE] = INCOMPLETE, [DROP_MAPPING_ERROR] = REFUSED}};
static const struct targets to = {.layout = &layout, .sources = sources, .collect = &collects, .targets = &only, .count = 1,
                                  .topic = NO_NAME};
static counter counters[COUNTERS];
static struct thread_env env;
static int64_t now = 1, offered, delivered;

static void demand(bool condition) {
    if (!condition) abort();
}

static int64_t clock_now(struct thread_env *of) {
    (void)of;
    return now;
}

int LLVMFuzzerInitialize(int *argc, char ***arguments) {
    (void)argc, (void)arguments;
    struct timers *timers = timers_open_on(&env, false);
    demand(timers && env_open(&env, counters, ring_open(1 << 12), timers));
    env.now = clock_now;
    collects.collector = collector_open(TIMEOUT);
    demand(collects.collector != NULL);
    const struct adoption adoption = {.timer = &collects.collector->timer, .to = &to};
    timers_change(timers, &(struct timer_change){.adopted = &adoption, .adopted_count = 1});
    return 0;
}

static size_t put_varint(uint8_t *to_, size_t at, uint64_t number) {
    for (; number > 0x7f; number >>= 7) to_[at++] = (uint8_t)(number | 0x80);
    to_[at++] = (uint8_t)number;
    return at;
}

static uint8_t filling(uint64_t name, uint64_t index) { return (uint8_t)(name * 31 + index * 7); }

static uint32_t make(uint8_t *data, uint64_t name, uint64_t size, uint64_t index, uint32_t more) {
    size_t at = 0;
    const uint64_t values[] = {name, size, index};
    for (uint8_t number = 0; number < 3; number++) {
        data[at++] = (uint8_t)((number + 1) << 3 | VARINT);
        at = put_varint(data, at, values[number]);
    }
    data[at++] = 4 << 3 | LEN;
    at = put_varint(data, at, more);
    memset(data + at, filling(name, index), more);
    return (uint32_t)at + more;
}

static uint64_t take_field(struct bytes *from, uint32_t number) {
    uint32_t tag;
    uint64_t value;
    demand(read_tag(from, &tag) && tag == (number << 3 | VARINT) && read_varint(from, LONGEST_VARINT, &value));
    return value;
}

/* All parts of a frame are there, in order, as they were sent. */
static void check_frame(uint64_t name, uint64_t size) {
    struct value *slots = env.machine.slots, list = slots[ITEMS];
    demand(list.size == size && slots[COUNTED].bits == size && slots[BY].bits == name && !slots[PLACE].bits);
    for (uint64_t index = 0; index < size; index++) {
        struct value payload = list_next(&env.machine, &list, IN_CELLS);
        struct bytes rest = {payload.bytes, payload.bytes + payload.size}, filled;
        uint32_t tag;
        demand(take_field(&rest, 1) == name && take_field(&rest, 2) == size && take_field(&rest, 3) == index);
        demand(read_tag(&rest, &tag) && read_len(&rest, &filled) && rest.at == rest.end);
        for (; filled.at < filled.end; filled.at++) demand(*filled.at == filling(name, index));
    }
}

static void check_limits(void) {
    const struct collector *of = collects.collector;
    int64_t known = delivered + of->open;
    for (int which = 0; which < COUNTERS; which++) known += counters[which];
    demand(known == offered);
    demand(of->open <= MOST_FRAMES && of->parts <= MOST_PARTS && of->bytes <= MOST_PART_BYTES && of->closed <= MOST_CLOSED);
    demand(of->used <= STORE && of->stored <= of->used);
    demand(of->timer.due == (of->open ? of->order[0]->ends_at : NEVER));
}

static void offer_one(uint64_t name, uint64_t size, uint64_t index, uint32_t column, uint32_t more) {
    static uint8_t data[MAX_DATAGRAM];
    struct datagram datagram = {.data = data, .column = column, .is_single = true};
    datagram.size = datagram.length = make(data, name, size, index, more);
    struct message message = {.datagram = &datagram, .now = now};
    offered++;
    if (collect(&env, &to, &message)) {
        delivered++;
        demand(message.is_read && message.outcome == EVALUATED);
        check_frame(name, size);
    }
    check_limits();
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    static const uint64_t SIZES[] = {0, 1, 2, 3, 5, 16, 100, 1000, MOST_PARTS, MOST_PARTS + 1, UINT32_MAX, UINT64_MAX};
    static const int64_t PAUSES[] = {0, 0, 1, 1000000, 100000000, 999999999, 1000000000, 3000000000};
    for (; size >= 4; input += 4, size -= 4) {
        uint64_t of = SIZES[input[2] % (sizeof SIZES / sizeof *SIZES)], first = input[3] >> 4;
        uint32_t more = input[0] & 1 ? (uint32_t)input[1] * 60 : input[1];
        now += PAUSES[input[0] >> 1 & 7];
        if (input[0] & 16) timers_serve(env.timers, now);
        for (uint64_t index = 0; index <= (input[3] & 15u) * (input[0] & 32 ? 70u : 1u); index++)
            offer_one(input[2] >> 4 | input[0] >> 6 << 4, of, first + index, input[0] >> 7, more);
    }
    now += 3 * TIMEOUT;
    timers_serve(env.timers, now);
    demand(!collects.collector->open);
    check_limits();
    return 0;
}
