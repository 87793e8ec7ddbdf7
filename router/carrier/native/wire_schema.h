/* The message types of an envelope, flattened by image/wire_schema.py. */
#ifndef WIRE_SCHEMA_H
#define WIRE_SCHEMA_H

#include <stdint.h>

struct wire_field {
    uint32_t number;
    uint8_t kind;  /* one of enum wire_kind */
    uint8_t flags; /* of enum wire_flag */
    uint16_t type; /* for a message or group: index of its type */
};
enum wire_kind { WIRE_VARINT, WIRE_I64, WIRE_I32, WIRE_BYTES, WIRE_STRING, WIRE_MESSAGE, WIRE_GROUP };
enum wire_flag {
    WIRE_PACKABLE = 1, /* a repeated scalar: its elements may be packed or not */
    WIRE_CASE = 2,     /* in the envelope: a field that is a payload case */
    WIRE_ROUTED = 4,   /* a case that has a route, which is always a message */
};

struct wire_type {
    const struct wire_field *fields; /* by ascending number */
    uint32_t count;
    uint32_t accepts_zero; /* field number 0 is allowed, as in messages that declare no fields */
};

/* How an envelope says which message it holds. */
enum case_by {
    BY_ONEOF, /* the member of a oneof */
    BY_CASES, /* each of some fields of the envelope that is present: a frame may hold several messages */
    BY_FRAME, /* the frame is the message of the only case, ONLY_CASE */
    BY_NAME   /* a field with the name of the message, and one with its bytes */
};
enum { ONLY_CASE = 1 };

/* What names a case. Its number is its index + 1. */
struct wire_name {
    const uint8_t *text;
    uint32_t size;
    uint16_t type; /* of its messages; 0 if they are not checked, because no route takes them */
    uint16_t reserved;
};

struct wire_schema {
    const struct wire_type *types; /* the first one is the envelope */
    uint32_t count;
    uint32_t case_by;
    /* BY_NAME: the names of the cases in the order of their bytes, and the numbers of the fields. */
    const struct wire_name *names;
    uint32_t name_count, name_field, payload_field;
    uint32_t reserved;
};

#endif
