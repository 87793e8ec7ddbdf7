#include "framing.h"

#include <string.h>

enum { SLIP_END = 0xC0, SLIP_ESCAPE = 0xDB, SLIP_ESCAPED_END = 0xDC, SLIP_ESCAPED_ESCAPE = 0xDD };
enum { HDLC_FLAG = 0x7E, HDLC_ESCAPE = 0x7D, HDLC_FLIPPED = 0x20, HDLC_CONTROL = 0x03, HDLC_HEADER = 2 };
enum { COBS_DELIMITER = 0, COBS_FULL = 0xFF /* the code of a block that no zero follows */ };
enum { LONGEST_LENGTH = 5 };

/* ---- checksums ---- */

struct crc {
    uint32_t polynomial; /* reversed if the CRC takes the lowest bit first */
    uint32_t start, flipped;
    uint32_t size; /* bytes */
    bool is_reversed;
};

static const struct crc CRCS[] = {
    [CHECKSUM_CRC8] = {0x07, 0, 0, 1, false},
    [CHECKSUM_CRC16_XMODEM] = {0x1021, 0, 0, 2, false},
    [CHECKSUM_CRC16_CCITT_FALSE] = {0x1021, 0xFFFF, 0, 2, false},
    [CHECKSUM_CRC16_MODBUS] = {0xA001, 0xFFFF, 0, 2, true},
    [CHECKSUM_CRC32] = {0xEDB88320, 0xFFFFFFFF, 0xFFFFFFFF, 4, true},
};

size_t checksum_size(uint32_t kind) { return CRCS[kind].size; }

/* Bit by bit: at the speed of a serial line, tables would save nothing that can be measured. */
uint32_t checksum_of(uint32_t kind, const uint8_t *bytes, size_t length) {
    const struct crc *crc = &CRCS[kind];
    if (!crc->size) return 0;
    uint32_t value = crc->start, bits = 8 * crc->size, top = 1U << (bits - 1);
    for (size_t index = 0; index < length; index++) {
        value ^= crc->is_reversed ? bytes[index] : (uint32_t)bytes[index] << (bits - 8);
        for (int bit = 0; bit < 8; bit++) {
            if (crc->is_reversed) value = value >> 1 ^ (value & 1 ? crc->polynomial : 0);
            else value = value << 1 ^ (value & top ? crc->polynomial : 0);
        }
    }
    return (value ^ crc->flipped) & ((top << 1) - 1);
}

/* ---- numbers ---- */

static void write_number(uint8_t *to, uint32_t number, size_t size, bool is_big_endian) {
    for (size_t index = 0; index < size; index++)
        to[is_big_endian ? size - 1 - index : index] = (uint8_t)(number >> 8 * index);
}

static uint32_t read_number(const uint8_t *from, size_t size, bool is_big_endian) {
    uint32_t number = 0;
    for (size_t index = 0; index < size; index++)
        number |= (uint32_t)from[is_big_endian ? size - 1 - index : index] << 8 * index;
    return number;
}

struct number {
    uint32_t size;
    bool is_big_endian;
};

static const struct number LENGTHS[] = {
    [FRAMING_LENGTH_U8] = {1, false},    [FRAMING_LENGTH_U16LE] = {2, false}, [FRAMING_LENGTH_U16BE] = {2, true},
    [FRAMING_LENGTH_U32LE] = {4, false}, [FRAMING_LENGTH_U32BE] = {4, true},
};

/* ---- decoding ---- */

static void begin_frame(struct deframer *deframer) {
    deframer->size = deframer->left = deframer->code = 0;
    deframer->has_begun = deframer->is_escaped = deframer->is_bad = false;
}

void deframer_begin(struct deframer *deframer, const struct framing *framing) {
    deframer->framing = *framing;
    begin_frame(deframer);
}

bool deframer_is_within(const struct deframer *deframer) { return deframer->has_begun || deframer->code; }

static size_t header_size(const struct framing *framing) { return framing->kind == FRAMING_HDLC ? HDLC_HEADER : 0; }

static uint32_t most_content(const struct framing *framing) {
    return (uint32_t)(header_size(framing) + MAX_DATAGRAM + checksum_size(framing->checksum));
}

static void take(struct deframer *deframer, uint8_t byte) {
    if (deframer->size == most_content(&deframer->framing)) deframer->is_bad = true;
    else deframer->content[deframer->size++] = byte;
}

static uint8_t hdlc_address(const struct framing *framing) { return (uint8_t)(framing->address << 1 | 1); }

/* A frame is complete: check it, and begin the next one. */
static enum framed finish(struct deframer *deframer) {
    const struct framing *framing = &deframer->framing;
    size_t header = header_size(framing), checksum = checksum_size(framing->checksum), size = deframer->size;
    const uint8_t *content = deframer->content;
    bool is_bad = deframer->is_bad || size < header + checksum;
    begin_frame(deframer);
    if (is_bad) return FRAME_BAD;
    if (checksum) {
        uint32_t written = read_number(content + size - checksum, checksum, framing->is_big_endian);
        if (written != checksum_of(framing->checksum, content, size - checksum)) return FRAME_BAD_CHECKSUM;
    }
    if (header && (content[0] != hdlc_address(framing) || content[1] != HDLC_CONTROL)) return FRAME_BAD;
    deframer->payload = content + header;
    deframer->length = (uint32_t)(size - header - checksum);
    return FRAME_READY;
}

/* Each of these takes one byte. */

static enum framed take_cobs(struct deframer *deframer, uint8_t byte) {
    if (byte == COBS_DELIMITER) {
        if (!deframer->has_begun) return FRAME_PARTIAL; /* idle */
        deframer->is_bad |= deframer->left > 0;
        return finish(deframer);
    }
    bool is_first = !deframer->has_begun;
    deframer->has_begun = true;
    if (deframer->left) {
        take(deframer, byte);
        deframer->left--;
    } else {
        if (!is_first && deframer->code != COBS_FULL) take(deframer, 0);
        deframer->code = byte;
        deframer->left = byte - 1U;
    }
    return FRAME_PARTIAL;
}

static enum framed take_escaped(struct deframer *deframer, uint8_t byte) {
    bool is_slip = deframer->framing.kind == FRAMING_SLIP;
    if (byte == (is_slip ? SLIP_END : HDLC_FLAG)) {
        if (!deframer->has_begun) return FRAME_PARTIAL;
        deframer->is_bad |= deframer->is_escaped;
        return finish(deframer);
    }
    deframer->has_begun = true;
    if (deframer->is_escaped) {
        deframer->is_escaped = false;
        if (!is_slip) take(deframer, byte ^ HDLC_FLIPPED);
        else if (byte == SLIP_ESCAPED_END) take(deframer, SLIP_END);
        else if (byte == SLIP_ESCAPED_ESCAPE) take(deframer, SLIP_ESCAPE);
        else deframer->is_bad = true;
    } else if (byte == (is_slip ? SLIP_ESCAPE : HDLC_ESCAPE)) {
        deframer->is_escaped = true;
    } else {
        take(deframer, byte);
    }
    return FRAME_PARTIAL;
}

/* Take a byte of the length. `left` grows until it is complete; `code` counts its bytes. Return whether it is. */
static bool take_length(struct deframer *deframer, uint8_t byte) {
    uint32_t kind = deframer->framing.kind, index = deframer->code++;
    if (kind == FRAMING_VARINT) {
        deframer->is_bad |= index == LONGEST_LENGTH - 1 && byte > 0x0F;
        deframer->left |= (uint32_t)(byte & 0x7F) << 7 * index;
        return byte < 0x80 || deframer->is_bad;
    }
    const struct number *length = &LENGTHS[kind];
    deframer->left |= (uint32_t)byte << 8 * (length->is_big_endian ? length->size - 1 - index : index);
    return deframer->code == length->size;
}

static enum framed take_counted(struct deframer *deframer, const uint8_t **bytes, const uint8_t *end) {
    while (!deframer->has_begun && *bytes < end) {
        deframer->has_begun = take_length(deframer, *(*bytes)++);
        if (!deframer->has_begun) continue;
        deframer->is_bad |= deframer->left > most_content(&deframer->framing);
        if (deframer->is_bad) return finish(deframer);
    }
    if (!deframer->has_begun) return FRAME_PARTIAL;
    size_t there = (size_t)(end - *bytes), taken = there < deframer->left ? there : deframer->left;
    memcpy(deframer->content + deframer->size, *bytes, taken);
    *bytes += taken;
    deframer->size += (uint32_t)taken;
    deframer->left -= (uint32_t)taken;
    return deframer->left ? FRAME_PARTIAL : finish(deframer);
}

enum framed deframe(struct deframer *deframer, const uint8_t **bytes, const uint8_t *end) {
    uint32_t kind = deframer->framing.kind;
    if (kind >= FRAMING_VARINT) return take_counted(deframer, bytes, end);
    enum framed framed = FRAME_PARTIAL;
    while (framed == FRAME_PARTIAL && *bytes < end) {
        uint8_t byte = *(*bytes)++;
        framed = kind == FRAMING_COBS ? take_cobs(deframer, byte) : take_escaped(deframer, byte);
    }
    return framed;
}

/* ---- encoding ---- */

int framing_delimiter(const struct framing *framing) {
    switch (framing->kind) {
    case FRAMING_COBS: return COBS_DELIMITER;
    case FRAMING_SLIP: return SLIP_END;
    case FRAMING_HDLC: return HDLC_FLAG;
    default: return -1;
    }
}

static size_t write_cobs(const uint8_t *content, size_t size, uint8_t *to) {
    uint8_t *code = to, *at = to + 1;
    for (size_t index = 0; index < size; index++) {
        if (content[index]) *at++ = content[index];
        bool is_full = at - code == COBS_FULL;
        if (content[index] && !(is_full && index + 1 < size)) continue;
        *code = (uint8_t)(at - code);
        code = at++;
    }
    *code = (uint8_t)(at - code);
    *at++ = COBS_DELIMITER;
    return (size_t)(at - to);
}

static size_t write_slip(const uint8_t *content, size_t size, uint8_t *to) {
    uint8_t *at = to;
    for (size_t index = 0; index < size; index++) {
        uint8_t byte = content[index];
        bool is_special = byte == SLIP_END || byte == SLIP_ESCAPE;
        if (is_special) *at++ = SLIP_ESCAPE;
        *at++ = !is_special ? byte : byte == SLIP_END ? SLIP_ESCAPED_END : SLIP_ESCAPED_ESCAPE;
    }
    *at++ = SLIP_END;
    return (size_t)(at - to);
}

static size_t write_hdlc(const uint8_t *content, size_t size, uint8_t *to) {
    uint8_t *at = to;
    *at++ = HDLC_FLAG;
    for (size_t index = 0; index < size; index++) {
        uint8_t byte = content[index];
        bool is_special = byte == HDLC_FLAG || byte == HDLC_ESCAPE;
        if (is_special) *at++ = HDLC_ESCAPE;
        *at++ = is_special ? byte ^ HDLC_FLIPPED : byte;
    }
    *at++ = HDLC_FLAG;
    return (size_t)(at - to);
}

static size_t write_counted(uint32_t kind, const uint8_t *content, size_t size, uint8_t *to) {
    uint8_t *at = to;
    if (kind == FRAMING_VARINT) {
        size_t left = size;
        for (; left >= 0x80; left >>= 7) *at++ = (uint8_t)(left | 0x80);
        *at++ = (uint8_t)left;
    } else {
        const struct number *length = &LENGTHS[kind];
        if (length->size == 1 && size > UINT8_MAX) return 0;
        write_number(at, (uint32_t)size, length->size, length->is_big_endian);
        at += length->size;
    }
    memcpy(at, content, size);
    return (size_t)(at - to) + size;
}

size_t frame_write(const struct framing *framing, const uint8_t *payload, size_t length, uint8_t *to) {
    uint8_t content[LONGEST_CONTENT];
    size_t size = header_size(framing), checksum = checksum_size(framing->checksum);
    if (length > MAX_DATAGRAM) return 0;
    if (size) {
        content[0] = hdlc_address(framing);
        content[1] = HDLC_CONTROL;
    }
    memcpy(content + size, payload, length);
    size += length;
    write_number(content + size, checksum_of(framing->checksum, content, size), checksum, framing->is_big_endian);
    size += checksum;
    switch (framing->kind) {
    case FRAMING_COBS: return write_cobs(content, size, to);
    case FRAMING_SLIP: return write_slip(content, size, to);
    case FRAMING_HDLC: return write_hdlc(content, size, to);
    default: return write_counted(framing->kind, content, size, to);
    }
}
