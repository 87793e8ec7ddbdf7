/* The payload of a datagram in one piece. */
#ifndef PAYLOAD_H
#define PAYLOAD_H

#include <stdint.h>
#include <string.h>

#include "deliver.h"
#include "wire.h"

/* Write the payload of a datagram, which takes at most `length` bytes, and return its size. Joining its pieces merges them. */
static inline uint32_t write_payload(const struct datagram *from, uint8_t *to) {
    struct bytes rest = {from->data + from->start, from->data + from->start + from->length}, piece;
    uint32_t tag = 0, size = 0;
    if (from->is_single) {
        memcpy(to, rest.at, from->length);
        return from->length;
    }
    while (rest.at < rest.end && read_piece(&rest, &tag, &piece)) {
        memcpy(to + size, piece.at, bytes_left(&piece));
        size += (uint32_t)bytes_left(&piece);
    }
    return size;
}

#endif
