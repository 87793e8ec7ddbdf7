/* Reads the wanted fields of a serialized ROS message into slots.
 *
 * Plain CDR, little-endian: four bytes of header, then each scalar aligned to its own size, relative to the end of the
 * header. A string is its length with the final NUL (32 bits), then the bytes; a sequence is the number of elements, then
 * the elements. Publishers are not trusted: lengths beyond the end of the message are refused. */
#ifndef READ_CDR_H
#define READ_CDR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "machine.h"

/* Read a message with its header into the slots of a section, which hold their defaults. */
bool read_cdr(struct machine *machine, uint16_t section, const uint8_t *message, size_t size);

/* Likewise for a list element, which begins at `beginning` in the last message read. */
bool read_cdr_element(struct machine *machine, uint16_t section, const uint8_t *beginning);

#endif
