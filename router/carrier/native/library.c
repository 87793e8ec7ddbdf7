/* What Python compares with its own side when it loads the library: library.py. */
#include <stddef.h>

#include "carrier.h"
#include "commands.h"
#include "publishing.h"

struct structure_size {
    const char *name;
    size_t size;
};

#define SIZE(name) {#name, sizeof(struct name)}

const char *carrier_checksum(void);
const struct structure_size *carrier_structure_sizes(void);

/* The checksum of the sources that this library was made of. */
const char *carrier_checksum(void) { return CARRIER_CHECKSUM; }

/* The structures that structures.py has too. The last one has no name. */
const struct structure_size *carrier_structure_sizes(void) {
    static const struct structure_size sizes[] = {
        SIZE(born), SIZE(wire_field),     SIZE(wire_type), SIZE(wire_schema), SIZE(limit), SIZE(feed),
        SIZE(destination),    SIZE(waiting),   SIZE(part),        SIZE(route), SIZE(entry),
        SIZE(payload_case),   SIZE(peer),      SIZE(listener),    SIZE(program), SIZE(change),
        SIZE(message_record), SIZE(mirror_record), SIZE(read_op), SIZE(write_op), SIZE(command_target), SIZE(command_route),
        SIZE(command_topic), SIZE(command_set), SIZE(deadman_destination),
        SIZE(value), SIZE(node_field), SIZE(node), SIZE(operation), SIZE(board_field), SIZE(board_message), SIZE(board), SIZE(publish_topic), SIZE(publish_target), SIZE(publish_route), {NULL, 0},
    };
    return sizes;
}
