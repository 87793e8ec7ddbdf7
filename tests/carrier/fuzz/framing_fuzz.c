/* A libFuzzer target: whatever arrives, and however it is cut, frames stay within their buffers, and do not depend on the cuts;
 * and each payload comes out as it went in. The first three bytes of an input choose the framing, the cuts, and where the
 * payload ends. */
#include "framing.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);

enum { CHOICES = 3, MOST_FOUND = 4096 };

struct found {
    uint8_t bytes[MOST_FOUND];
    size_t size;
    bool has_ended;
};

static void demand(bool condition) {
    if (!condition) abort();
}

static void note(struct found *found, const void *bytes, size_t size) {
    demand(size <= MOST_FOUND - found->size);
    memcpy(found->bytes + found->size, bytes, size);
    found->size += size;
}

static void take(struct deframer *deframer, const uint8_t *bytes, size_t size, struct found *found) {
    /* On the heap, so that the sanitizer sees what is read beyond the end. */
    uint8_t *copy = malloc(size + !size);
    demand(copy != NULL);
    memcpy(copy, bytes, size);
    const uint8_t *next = copy;
    while (!found->has_ended) {
        enum framed framed = deframe(deframer, &next, copy + size);
        demand(next <= copy + size);
        if (framed == FRAME_PARTIAL) break;
        note(found, &(uint8_t){(uint8_t)framed}, 1);
        if (framed == FRAME_READY) note(found, deframer->payload, deframer->length);
        else found->has_ended = framing_delimiter(&deframer->framing) < 0;
    }
    free(copy);
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    static struct deframer whole, cut;
    static struct found at_once, in_pieces, back;
    static uint8_t frame[LONGEST_FRAME];
    if (size < CHOICES || size > 400) return 0;
    struct framing framing = {.kind = input[0] % (FRAMING_LENGTH_U32BE + 1), .checksum = input[1] % (CHECKSUM_CRC32 + 1),
                              .is_big_endian = input[1] >> 7, .address = input[0] >> 1};
    if (framing.kind == FRAMING_HDLC) framing.checksum = CHECKSUM_CRC32;
    size_t step = (size_t)input[2] % 16 + 1;
    input += CHOICES;
    size -= CHOICES;

    at_once.size = in_pieces.size = back.size = 0;
    at_once.has_ended = in_pieces.has_ended = back.has_ended = false;
    deframer_begin(&whole, &framing);
    take(&whole, input, size, &at_once);
    deframer_begin(&cut, &framing);
    for (size_t at = 0; at < size; at += step) take(&cut, input + at, size - at < step ? size - at : step, &in_pieces);
    demand(at_once.size == in_pieces.size && !memcmp(at_once.bytes, in_pieces.bytes, at_once.size));

    size_t length = frame_write(&framing, input, size, frame);
    demand(length <= LONGEST_FRAME);
    bool is_idle = framing.kind == FRAMING_SLIP && !size && !framing.checksum;
    if (!length || is_idle) return 0;
    deframer_begin(&whole, &framing);
    take(&whole, frame, length, &back);
    demand(back.size == size + 1 && back.bytes[0] == FRAME_READY && !memcmp(back.bytes + 1, input, size));
    return 0;
}
