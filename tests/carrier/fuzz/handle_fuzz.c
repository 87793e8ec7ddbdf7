/* A libFuzzer target: what the receive thread does with a datagram reads and writes only what it may, and the counters
 * balance. The first byte of an input selects listener and sender, the rest is the datagram. */
#include <stdlib.h>

#include "defer.h"
#include "carrier.c"
#include "schemas.h"

enum { MOST_CASES = 64, COLUMNS = 3, LISTENERS = 2, OF_LISTENER = 4 + REASONS };
/* Counters of the one route behind those of listeners. */
enum { ROUTE = LISTENERS * OF_LISTENER, ACCEPTED = ROUTE, SENT, SENT_BYTES, STALE, LIMITED, FULL, FAILED, WAITING,
       QUEUE_FULL, FILTERED, MET, UNMET, REFUSED, PACED, HELD, LAST_MESSAGE, SEEN, HEARD, SILENCES, SILENCE,
       UNHANDLED_CASES, LOST, DURATION, COUNTERS = DURATION + 14 };

int LLVMFuzzerInitialize(int *count, char ***arguments);
int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);

static counter counters[COUNTERS];
static struct limit limit = {1000, 500, -1000};
static struct limit *const limits[COLUMNS] = {&limit, &limit, &limit};
static struct deferral *deferrals[2][COLUMNS];
static struct demand whole = {.wanted = EVERY_MESSAGE};
static const struct topic topic = {.demand = &whole};
static const struct target published = {
    .topic = &topic, .waiting = WAITING, .filtered = FILTERED, .dropped = {[DROP_QUEUE_FULL] = QUEUE_FULL}};
static struct sender nowhere = {.fd = -1};
/* A condition on the first field that every payload may have. */
static const struct wanted_field fields[] = {{.number = 1, .type = TYPE_INT32, .slot = 2, .presence = NONE, .section = NONE,
                                            .choice = NONE, .closed = NONE}};
static const struct section sections[] = {{.fields = fields, .count = 1}};
static const struct value defaults[3], sources[COLUMNS];
static const struct layout layout = {.sections = sections, .defaults = defaults, .slot_count = 3};
static const struct operation condition[] = {{.kind = OP_INTEGER, .integer = 6}, {.kind = OP_LOAD, .slot = 2},
                                             {.kind = OP_DIVIDE}};

static struct target destinations[] = {
    {.sender = &nowhere, .limits = limits, .trims = 1, .delivered = SENT, .delivered_bytes = SENT_BYTES,
     .dropped = {[DROP_STALE] = STALE, [DROP_RATE_LIMITED] = LIMITED, [DROP_SEND_BUFFER_FULL] = FULL,
                 [DROP_SEND_ERROR] = FAILED}},
    {.sender = &nowhere, .condition = {condition, 3, 0}, .filtered = UNMET,
     .dropped = {[DROP_MAPPING_ERROR] = REFUSED, [DROP_STALE] = MET, [DROP_SEND_ERROR] = MET}},
    {.sender = &nowhere, .trims = 1, .priority = PRIORITY_BULK,
     .dropped = {[DROP_STALE] = PACED, [DROP_QUEUE_FULL] = PACED, [DROP_SEND_ERROR] = PACED}},
    {.sender = &nowhere, .period = 1000000,
     .dropped = {[DROP_STALE] = HELD, [DROP_RATE_LIMITED] = HELD, [DROP_SEND_ERROR] = HELD}}};
static const struct route only = {
    .sends = {.ttl = 1000000000, .layout = &layout, .sources = sources, .targets = destinations, .count = 4,
              .topic = NO_NAME},
    .publishes = {.targets = &published, .count = 1},
    .last_message = LAST_MESSAGE, .duration = DURATION};
static const struct peer peers[] = {
    {.address = 1, .port = 7, .last_seen = SEEN, .heard_since = HEARD, .silences = SILENCES, .last_silence = SILENCE},
    {.address = 1, .column = 1, .last_seen = SEEN, .heard_since = HEARD, .id = 1, .pause = INT64_MAX},
    {.address = 2, .port = 9, .column = 1, .last_seen = SEEN, .heard_since = HEARD, .id = 1, .pause = INT64_MAX}};
static const struct choice choices[] = {{0, ACCEPTED}, {-1, 0}, {0, ACCEPTED}}; /* strangers, too */
static struct payload_case cases[MOST_CASES];
static struct listener listeners[LISTENERS];
static struct program program = {.generation = 1, .listener_count = LISTENERS,
                                 .listeners = listeners, .routes = &only};
static struct protocol protocol = {.cases = cases, .unknown_case = UNHANDLED_CASES};
static struct carrier *carrier;

static void demand(bool condition) {
    if (!condition) abort();
}

int LLVMFuzzerInitialize(int *count, char ***arguments) {
    (void)count, (void)arguments;
    protocol.schema = schemas[0];
    const struct wire_type *envelope = &protocol.schema.types[0];
    for (uint32_t index = 0; index < envelope->count; index++) {
        const struct wire_field *field = &envelope->fields[index];
        if (!(field->flags & WIRE_CASE)) continue;
        demand(protocol.case_count < MOST_CASES);
        cases[protocol.case_count++] = (struct payload_case){.number = field->number, .unhandled = UNHANDLED_CASES,
                                                            .row = field->flags & WIRE_ROUTED ? 0 : -1,
                                                            .is_ignored = field->number % 2};
    }
    for (uint32_t index = 0; index < LISTENERS; index++) {
        uint32_t first = index * OF_LISTENER;
        listeners[index] = (struct listener){.fd = -1, .repairs = index, .protocol = &protocol, .peers = peers, .choices = choices, .peer_count = 3,
                                             .columns = COLUMNS, .received = first, .received_bytes = first + 1,
                                             .padded = first + 2, .superseded = first + 3};
        for (uint32_t reason = 0; reason < REASONS; reason++) listeners[index].rejected[reason] = first + 4 + reason;
    }
    struct ring *events = ring_open(1 << 15);
    carrier = carrier_open(timers_open(counters, events), counters, events, ring_open(1 << 15));
    struct pacer *pacer = pacer_open(100000);
    struct adoption adopted[] = {{(struct timer *)pacer, NULL, NULL}, {NULL, &only.sends, &destinations[2]},
                                 {NULL, &only.sends, &destinations[3]}};
    for (int index = 1; index < 3; index++) {
        struct deferral *deferral = deferral_open(index == 1 ? pacer : NULL);
        for (uint32_t column = 0; column < COLUMNS; column++) deferrals[index - 1][column] = deferral;
        destinations[1 + index].deferrals = deferrals[index - 1];
        adopted[index].timer = (struct timer *)deferral;
    }
    struct change first = {.program = &program, .timers = {.adopted = adopted, .adopted_count = 3}};
    adopt(carrier, &first);
    carrier_mirror(carrier, ring_open(1 << 15), LOST);
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    if (!size || size > MAX_DATAGRAM + 2) return 0;
    uint8_t chosen = input[0];
    struct received received = {.listener = &listeners[chosen % 2], .length = size - 1, .address = chosen / 2 % 4,
                                .port = chosen & 16 ? 7 : 9, .arrived_at = chosen & 32 ? 1 : 0};
    memcpy(carrier->routing.datagram, input + 1, size - 1);
    handle(carrier, &received);
    int64_t balance = counters[ACCEPTED];
    for (uint32_t index = 0; index < LISTENERS; index++) {
        balance -= counters[listeners[index].received];
        for (uint32_t reason = 0; reason < REASONS; reason++) balance += counters[listeners[index].rejected[reason]];
    }
    demand(balance == 0);
    demand(counters[ACCEPTED] == counters[STALE] + counters[LIMITED] + counters[FAILED]);
    demand(counters[ACCEPTED] == counters[MET] + counters[UNMET] + counters[REFUSED]);
    demand(counters[ACCEPTED] == counters[WAITING] + counters[QUEUE_FULL]);
    demand(counters[PACED] <= counters[ACCEPTED] && counters[ACCEPTED] - counters[PACED] <= 100000 / BYTES_PER_WAITING);
    demand(counters[HELD] <= counters[ACCEPTED] && counters[ACCEPTED] - counters[HELD] <= 1);
    serve_due(carrier);
    return 0;
}
