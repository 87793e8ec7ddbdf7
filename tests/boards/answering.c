/* A board that answers requests and calls a service, in nanopb as the firmware is, over a link that fails by chance.
 *
 *     answering ADDRESS PORT ROUTER_ADDRESS ROUTER_PORT SEED
 *
 * It replies to each arm_request with an arm_reply of the same number and value: at once, never, twice, later, so that
 * replies change their order, or too late. Or it sends what is no reply to that call: with another number, another
 * message with this number, or part of a reply.
 *
 * It calls a service with home_request, with the same number every 200 ms until it has a reply, of which it loses some.
 *
 * Each line of standard input is how many more times it calls the service. It answers each line with its counts so far,
 * a JSON object on one line. It ends with its input. Compiled with -DPROTO="...pb.h" of tests/bad_tables/protos/calls. */
#include PROTO

#include <arpa/inet.h>
#include <pb_decode.h>
#include <pb_encode.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { LARGEST = 64, WAITING = 4096, REMEMBERED = 1 << 16 };
enum { SOON_MS = 300, TOO_LATE_MS = 2000, AGAIN_MS = 200 };
enum { NOBODYS = 1u << 31 }; /* added to the number of a call, gives one that no call has */

struct waiting {
    int64_t due; /* 0 if unused */
    size_t size;
    uint8_t data[LARGEST];
};

static struct {
    unsigned requests; /* arm_request datagrams */
    unsigned calls;    /* different numbers of them */
    unsigned changed;  /* whose number came with other bytes before */
    unsigned right, misnumbered, others, parts;
    unsigned asked;    /* home_request datagrams */
    unsigned replied;  /* home_reply datagrams */
    unsigned called;   /* calls that have ended with the service's response */
    unsigned failed;   /* replies that say there is none */
    unsigned wrong;    /* replies whose values do not belong to their number */
    unsigned refused;  /* datagrams that nanopb does not decode */
} counts;

static int udp;
static struct sockaddr_in router;
static unsigned seed;
static struct waiting waiting[WAITING];
static uint32_t remembered[REMEMBERED], hashes[REMEMBERED]; /* numbers of requests, and what came with them */
static HomeRequest request;
static unsigned left; /* calls to make, with that which is open */
static int64_t ask_at;

static int64_t now_ms(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

static unsigned chance(unsigned below) { return (unsigned)rand_r(&seed) % below; }

static void send_now(const uint8_t *data, size_t size) {
    if (sendto(udp, data, size, 0, (const struct sockaddr *)&router, sizeof router) < 0) perror("board: sendto");
}

static size_t encode(const PBEnvelope *envelope, uint8_t *data) {
    pb_ostream_t stream = pb_ostream_from_buffer(data, LARGEST);
    if (!pb_encode(&stream, PBEnvelope_fields, envelope)) abort();
    return stream.bytes_written;
}

static void send_later(const PBEnvelope *envelope, int64_t delay) {
    struct waiting *free = waiting;
    while (free->due != 0)
        if (++free == waiting + WAITING) abort();
    free->due = now_ms() + delay;
    free->size = encode(envelope, free->data);
}

static void send_envelope(const PBEnvelope *envelope) {
    uint8_t data[LARGEST];
    send_now(data, encode(envelope, data));
}

static void remember(uint32_t number, const uint8_t *data, size_t size) {
    uint32_t hash = 2166136261u; /* FNV-1a */
    for (size_t i = 0; i < size; i++) hash = (hash ^ data[i]) * 16777619u;
    uint32_t *at = &remembered[number % REMEMBERED], *of = &hashes[number % REMEMBERED];
    if (*at != number) counts.calls++;
    else if (*of != hash) counts.changed++;
    *at = number;
    *of = hash;
}

static void answer(uint32_t number, const ArmRequest *asked) {
    PBEnvelope reply = {.req_id = number, .which_payload = PBEnvelope_arm_reply_tag};
    reply.payload.arm_reply = (ArmReply){.ok = asked->armed, .id = asked->id};
    uint8_t data[LARGEST];
    switch (chance(16)) {
    case 0:
    case 1: return; /* lost */
    case 2:
    case 3:
    case 4:
    case 5: send_later(&reply, chance(SOON_MS)); break;
    case 6: send_later(&reply, TOO_LATE_MS); break;
    case 7:
        reply.req_id += NOBODYS;
        send_envelope(&reply);
        counts.misnumbered++;
        return;
    case 8:
        reply.which_payload = PBEnvelope_log_tag;
        reply.payload.log = (Log){.number = asked->id};
        send_envelope(&reply);
        counts.others++;
        return;
    case 9:
        send_now(data, encode(&reply, data) - 1);
        counts.parts++;
        return;
    case 10: /* twice */
        send_envelope(&reply);
        counts.right++; /* fall through */
    default: send_envelope(&reply);
    }
    counts.right++;
}

static void ask(void) {
    PBEnvelope envelope = {.which_payload = PBEnvelope_home_request_tag};
    envelope.payload.home_request = request;
    send_envelope(&envelope);
    counts.asked++;
    ask_at = now_ms() + AGAIN_MS;
}

static void ask_next(void) {
    request = (HomeRequest){.id = request.id + 1, .fast = chance(2), .axis = chance(2) ? Axis_AXIS_Y : Axis_AXIS_X};
    request.offset = -(int64_t)request.id;
    ask();
}

static void take(const HomeReply *reply) {
    counts.replied++;
    if (reply->offset >= 0) { /* the length of a reason */
        counts.failed++;
        if (reply->found) counts.wrong++;
        return;
    }
    if (reply->offset != -(int64_t)reply->id || reply->found != reply->fast) counts.wrong++;
    if (left == 0 || reply->id != request.id || chance(4) == 0) return; /* an old one, or lost */
    if (reply->fast != request.fast || reply->axis != request.axis) counts.wrong++;
    counts.called++;
    if (--left > 0) ask_next();
}

static void receive(void) {
    uint8_t data[LARGEST];
    ssize_t size = recv(udp, data, sizeof data, 0);
    if (size < 0) return;
    PBEnvelope envelope = PBEnvelope_init_zero;
    pb_istream_t stream = pb_istream_from_buffer(data, (size_t)size);
    if (!pb_decode(&stream, PBEnvelope_fields, &envelope)) {
        counts.refused++;
    } else if (envelope.which_payload == PBEnvelope_arm_request_tag) {
        counts.requests++;
        remember(envelope.req_id, data, (size_t)size);
        answer(envelope.req_id, &envelope.payload.arm_request);
    } else if (envelope.which_payload == PBEnvelope_home_reply_tag) {
        take(&envelope.payload.home_reply);
    }
}

/* Send what is due, and return how long nothing is, in ms, at most a second. */
static int send_due(void) {
    int64_t now = now_ms(), next = now + 1000;
    for (struct waiting *each = waiting; each < waiting + WAITING; each++) {
        if (each->due != 0 && each->due <= now) {
            send_now(each->data, each->size);
            each->due = 0;
        } else if (each->due != 0 && each->due < next) {
            next = each->due;
        }
    }
    if (left > 0 && ask_at <= now) ask();
    if (left > 0 && ask_at < next) next = ask_at;
    return (int)(next - now);
}

static void print_counts(void) {
    unsigned later = 0;
    for (struct waiting *each = waiting; each < waiting + WAITING; each++) later += each->due != 0;
    printf("{\"requests\": %u, \"calls\": %u, \"changed\": %u, \"right\": %u, \"misnumbered\": %u, \"others\": %u, "
           "\"parts\": %u, \"asked\": %u, \"replied\": %u, \"called\": %u, \"failed\": %u, \"wrong\": %u, "
           "\"refused\": %u, \"waiting\": %u}\n",
           counts.requests, counts.calls, counts.changed, counts.right, counts.misnumbered, counts.others, counts.parts,
           counts.asked, counts.replied, counts.called, counts.failed, counts.wrong, counts.refused, later);
}

static void take_line(const char *line) {
    unsigned more = (unsigned)atoi(line), before = left;
    left += more;
    if (before == 0 && more > 0) ask_next();
    print_counts();
}

static struct sockaddr_in address(const char *host, const char *port) {
    struct sockaddr_in made = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
    inet_pton(AF_INET, host, &made.sin_addr);
    return made;
}

int main(int count, char **arguments) {
    if (count != 6) return EXIT_FAILURE;
    struct sockaddr_in here = address(arguments[1], arguments[2]);
    router = address(arguments[3], arguments[4]);
    seed = (unsigned)atoi(arguments[5]);
    udp = socket(AF_INET, SOCK_DGRAM, 0);
    setsockopt(udp, SOL_SOCKET, SO_RCVBUF, &(int){4 << 20}, sizeof(int));
    if (bind(udp, (struct sockaddr *)&here, sizeof here) != 0) {
        perror("board: bind");
        return EXIT_FAILURE;
    }
    char line[64];
    setvbuf(stdout, NULL, _IOLBF, 0);
    setvbuf(stdin, NULL, _IONBF, 0); /* poll sees what is not read yet */
    print_counts();
    struct pollfd inputs[] = {{.fd = udp, .events = POLLIN}, {.fd = STDIN_FILENO, .events = POLLIN}};
    while (poll(inputs, 2, send_due()) >= 0) {
        if (inputs[0].revents) receive();
        if (inputs[1].revents) {
            if (fgets(line, sizeof line, stdin) == NULL) return EXIT_SUCCESS;
            take_line(line);
        }
    }
    return EXIT_FAILURE;
}
