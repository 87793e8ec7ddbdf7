/* A board as upstream's firmware is: nanopb, one static envelope, and a datagram is decoded at exactly its length.
 *
 *     board ADDRESS PORT ROUTER_ADDRESS ROUTER_PORT
 *
 * It prints one line per datagram that arrives at ADDRESS:
 *
 *     obeyed CASE_NUMBER ENVELOPE     the envelope as nanopb encodes what it decoded, in hex
 *     refused DATAGRAM REASON         in hex, and nanopb's error
 *
 * A line of standard input makes it send an envelope to the router: a form and the envelope in hex. The form is `exact`,
 * `trimmed` (without the zeros at the end), `padded` (the whole buffer of the largest envelope) or `raw` (these bytes,
 * not decoded). It ends with its input.
 *
 * Compiled with -DPROTO="...pb.h" and -DENVELOPE=..., the C name of a message with a oneof `payload`. */
#include PROTO

#include <arpa/inet.h>
#include <pb_decode.h>
#include <pb_encode.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#define JOINED(a, b) a##b
#define NAMED(envelope, part) JOINED(envelope, part)

enum { LARGEST = NAMED(ENVELOPE, _size), MAX_DATAGRAM = 65535 };

static ENVELOPE envelope;
static uint8_t datagram[MAX_DATAGRAM];
static uint8_t encoded[LARGEST];

static void print_hex(const uint8_t *data, size_t size) {
    for (size_t i = 0; i < size; i++) printf("%02x", data[i]);
}

/* Encode the envelope into `encoded`, whose rest is zero. */
static size_t encode(void) {
    memset(encoded, 0, sizeof encoded);
    pb_ostream_t stream = pb_ostream_from_buffer(encoded, sizeof encoded);
    if (!pb_encode(&stream, &NAMED(ENVELOPE, _msg), &envelope)) {
        fprintf(stderr, "board: what was decoded cannot be encoded: %s\n", PB_GET_ERROR(&stream));
        exit(EXIT_FAILURE);
    }
    return stream.bytes_written;
}

/* Return nanopb's error, or NULL. */
static const char *decode(const uint8_t *data, size_t size) {
    if (size > LARGEST) return "longer than the envelope";
    pb_istream_t stream = pb_istream_from_buffer(data, size);
    return pb_decode(&stream, &NAMED(ENVELOPE, _msg), &envelope) ? NULL : PB_GET_ERROR(&stream);
}

static void dispatch(const uint8_t *data, size_t size) {
    const char *error = decode(data, size);
    if (error == NULL && envelope.which_payload == 0) error = "no payload";
    if (error == NULL) {
        printf("obeyed %d ", envelope.which_payload);
        print_hex(encoded, encode());
    } else {
        printf("refused ");
        print_hex(data, size);
        printf(" %s", error);
    }
    printf("\n");
}

static size_t read_hex(const char *text, uint8_t *data, size_t room) {
    size_t size = 0;
    for (unsigned byte; size < room && sscanf(text, "%2x", &byte) == 1; text += 2) data[size++] = (uint8_t)byte;
    return size;
}

static void send_line(int udp, const struct sockaddr_in *router, const char *form, const char *hex) {
    size_t size = read_hex(hex, datagram, sizeof datagram);
    const uint8_t *data = datagram;
    if (strcmp(form, "raw") != 0) {
        const char *error = decode(datagram, size);
        if (error) {
            fprintf(stderr, "board: told to send what it cannot decode: %s\n", error);
            exit(EXIT_FAILURE);
        }
        data = encoded;
        size = encode();
        if (strcmp(form, "padded") == 0) size = sizeof encoded;
        while (strcmp(form, "trimmed") == 0 && size > 0 && encoded[size - 1] == 0) size--;
    }
    if (sendto(udp, data, size, 0, (const struct sockaddr *)router, sizeof *router) < 0) perror("board: sendto");
}

static struct sockaddr_in address(const char *host, const char *port) {
    struct sockaddr_in made = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
    inet_pton(AF_INET, host, &made.sin_addr);
    return made;
}

int main(int count, char **arguments) {
    if (count != 5) return EXIT_FAILURE;
    struct sockaddr_in here = address(arguments[1], arguments[2]), router = address(arguments[3], arguments[4]);
    int udp = socket(AF_INET, SOCK_DGRAM, 0), room = 4 << 20;
    setsockopt(udp, SOL_SOCKET, SO_RCVBUF, &room, sizeof room);
    if (bind(udp, (struct sockaddr *)&here, sizeof here) != 0) {
        perror("board: bind");
        return EXIT_FAILURE;
    }
    static char line[2 * MAX_DATAGRAM + 16];
    setvbuf(stdout, NULL, _IOLBF, 0);
    setvbuf(stdin, NULL, _IONBF, 0); /* poll sees what is not read yet */
    printf("ready\n");
    struct pollfd inputs[] = {{.fd = udp, .events = POLLIN}, {.fd = STDIN_FILENO, .events = POLLIN}};
    while (poll(inputs, 2, -1) > 0) {
        if (inputs[0].revents) {
            ssize_t size = recv(udp, datagram, sizeof datagram, 0);
            if (size >= 0) dispatch(datagram, (size_t)size);
        }
        if (inputs[1].revents) {
            if (fgets(line, sizeof line, stdin) == NULL) return EXIT_SUCCESS;
            char *hex = strchr(line, ' ');
            if (hex == NULL) return EXIT_FAILURE;
            *hex = 0;
            send_line(udp, &router, line, hex + 1);
        }
    }
    return EXIT_FAILURE;
}
