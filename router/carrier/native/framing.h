/* Frames of a byte stream: a serial line, or a TCP connection.
 *
 * A deframer takes the bytes as they arrive and keeps a partial frame. Frames are decoded while they arrive, so nothing is
 * copied twice and nothing is allocated. After a bad frame it continues behind the next delimiter. A framing with lengths has
 * none: the lengths that follow a bad frame or checksum mean nothing, and the stream must be opened again.
 *
 *     COBS       Consistent Overhead Byte Stuffing, behind each frame a zero
 *     SLIP       RFC 1055
 *     HDLC       unnumbered information frames as Pigweed sends them: flag, address, 0x03, payload, CRC-32, flag
 *     VARINT     the length as a varint before each frame, as protobuf and nanopb write delimited messages
 *     LENGTH_*   the length as a number of fixed size
 *
 * A checksum follows the payload, inside the frame: a length counts it, COBS and SLIP encode it. */
#ifndef FRAMING_H
#define FRAMING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "envelope.h"

enum framing_kind {
    FRAMING_COBS,
    FRAMING_SLIP,
    FRAMING_HDLC,
    FRAMING_VARINT,
    FRAMING_LENGTH_U8,
    FRAMING_LENGTH_U16LE,
    FRAMING_LENGTH_U16BE,
    FRAMING_LENGTH_U32LE,
    FRAMING_LENGTH_U32BE
};

/* With the parameters of the CRC catalogue (reveng.sourceforge.io): CRC-8/SMBUS, CRC-16/XMODEM, CRC-16/IBM-3740,
 * CRC-16/MODBUS, CRC-32/ISO-HDLC. */
enum checksum_kind {
    CHECKSUM_NONE,
    CHECKSUM_CRC8,
    CHECKSUM_CRC16_XMODEM,
    CHECKSUM_CRC16_CCITT_FALSE,
    CHECKSUM_CRC16_MODBUS,
    CHECKSUM_CRC32
};

struct framing {
    uint32_t kind, checksum; /* enum framing_kind, enum checksum_kind; HDLC has CHECKSUM_CRC32 */
    uint32_t is_big_endian;  /* the checksum: its high byte first */
    uint32_t address;        /* of HDLC, below 128; frames with another one are bad */
};

enum { LONGEST_CHECKSUM = 4, LONGEST_HEADER = 2 /* of HDLC: address and control */ };
enum { LONGEST_CONTENT = LONGEST_HEADER + MAX_DATAGRAM + LONGEST_CHECKSUM };
/* The longest frame: SLIP and HDLC escape each byte, and have two delimiters. */
enum { LONGEST_FRAME = 2 * LONGEST_CONTENT + 2 };

enum framed {
    FRAME_PARTIAL,      /* all bytes are taken; the frame continues with the next ones */
    FRAME_READY,        /* `payload` has `length` bytes, until the next call */
    FRAME_BAD,          /* not encoded so, too long, or too short for its checksum */
    FRAME_BAD_CHECKSUM
};

struct deframer {
    struct framing framing;
    uint32_t size;       /* bytes of `content` */
    uint32_t left;       /* COBS: bytes of the block that are still to come; with a length: of the frame */
    uint32_t code;       /* COBS: of the block; with a length: bytes of it that have arrived */
    bool has_begun;      /* a byte of the frame has arrived */
    bool is_escaped;     /* SLIP and HDLC: the byte before was an escape */
    bool is_bad;         /* all bytes up to the next delimiter are part of a bad frame */
    const uint8_t *payload;
    uint32_t length;
    uint8_t content[LONGEST_CONTENT];
};

/* Begin a stream: forget a partial frame. */
void deframer_begin(struct deframer *deframer, const struct framing *framing);

/* Whether a frame has begun that is not complete. */
bool deframer_is_within(const struct deframer *deframer);

/* Take bytes from `*bytes` up to `end`, until a frame is complete, good or bad. `*bytes` is set behind the bytes taken. */
enum framed deframe(struct deframer *deframer, const uint8_t **bytes, const uint8_t *end);

/* Write a frame with a payload of up to MAX_DATAGRAM bytes to `to`, which has room for LONGEST_FRAME bytes. Return its size,
 * or 0 if the framing has no length for so many bytes. */
size_t frame_write(const struct framing *framing, const uint8_t *payload, size_t length, uint8_t *to);

/* Return the byte that ends any frame begun before, or -1 if the framing has none. */
int framing_delimiter(const struct framing *framing);

/* The checksum of bytes, and its size in bytes. */
uint32_t checksum_of(uint32_t kind, const uint8_t *bytes, size_t length);
size_t checksum_size(uint32_t kind);

#endif
