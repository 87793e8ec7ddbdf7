/* What Python compares with its own side when it loads the library: library.py. */
#include <stddef.h>

#include "carrier.h"
#include "collect.h"
#include "from_ros.h"
#include "publish.h"

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
        SIZE(born), SIZE(setting), SIZE(freshness), SIZE(wire_field), SIZE(wire_type), SIZE(wire_schema), SIZE(limit), SIZE(feed),
        SIZE(deadman_destination), SIZE(board_field), SIZE(board_message), SIZE(board), SIZE(value), SIZE(operation),
        SIZE(code), SIZE(node_field), SIZE(closed_enum), SIZE(read_operation), SIZE(node), SIZE(layout), SIZE(topic),
        SIZE(target), SIZE(targets), SIZE(collect), SIZE(route), SIZE(entry), SIZE(payload_case), SIZE(peer),
        SIZE(listener), SIZE(program), SIZE(adoption), SIZE(timer_change), SIZE(publish_change), SIZE(change),
        SIZE(message_record), SIZE(mirror_record),
        SIZE(for_each), SIZE(ros_route), SIZE(ros_topic), SIZE(ros_set), {NULL, 0},
    };
    return sizes;
}
