/* Reads the wanted fields of a protobuf message into slots, as the protobuf library would parse them: the last of several
 * values counts, messages that come in parts are merged, and a member of a oneof clears the others.
 *
 * The carrier has already checked the payload (envelope.h); a malformed one is refused nevertheless. */
#ifndef READ_PROTOBUF_H
#define READ_PROTOBUF_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "machine.h"

enum { MOST_SECTIONS_DEEP = 32 }; /* depth of nested messages */

/* Read a message into the slots of a section, which hold their defaults. */
bool read_protobuf(struct machine *machine, uint16_t section, const uint8_t *message, size_t size);

/* Likewise for a message in pieces: fields with the same number, the first one at `data`, perhaps with other fields
 * between them. */
bool read_protobuf_pieces(struct machine *machine, uint16_t section, const uint8_t *data, size_t size);

#endif
