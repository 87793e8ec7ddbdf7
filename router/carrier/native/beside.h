/* Fills the fields of an envelope beside its payload that differ from message to message: a number that counts up, and the
 * time of sending.
 *
 * Each has the same offset and size in all messages that the router makes for an endpoint, because all of its fields beside
 * the payload come first. A varint is padded to its size, which every decoder accepts. The fields are filled when a message
 * is sent, with the lock of the timers held, so messages leave in the order of their numbers. */
#ifndef BESIDE_H
#define BESIDE_H

#include <stdint.h>

enum beside_value { BESIDE_NUMBER, BESIDE_TIME };
enum beside_encoding { BESIDE_VARINT, BESIDE_ZIGZAG, BESIDE_FIXED, BESIDE_DOUBLE };

struct beside_field {
    uint16_t offset; /* in the message */
    uint8_t size;    /* in bytes */
    uint8_t encoding; /* enum beside_encoding */
    uint8_t value;    /* enum beside_value */
    uint8_t bits;     /* of a number, which wraps around like an integer of that many bits */
    uint8_t is_signed;
    uint8_t reserved;
    int64_t unit;     /* ns, of a time that is an integer */
    int64_t modulus;  /* the time is a remainder, such as the nanoseconds of a second; 0: it is not */
    double scale;     /* of a time that is a double: factor from ns */
};

struct sequence;

/* The fields of the messages for an endpoint. */
struct beside {
    struct sequence *sequence;
    const struct beside_field *fields;
    uint32_t count, reserved;
};

/* Open a sequence that begins with 1. Returns NULL if memory runs out. */
struct sequence *sequence_open(void);
void sequence_close(struct sequence *sequence);

/* Fill the fields of a message that is sent at `wall` (wall clock, ns). The router has made the message, so its bytes can be
 * written, although other messages are constant. */
void beside_fill(const struct beside *beside, const uint8_t *message, int64_t wall);

#endif
