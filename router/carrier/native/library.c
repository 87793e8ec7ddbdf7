/* Checks that Python makes when it loads the library (library.py). */
#include "rcl_types.h"

const char *carrier_checksum(void);

/* The checksum of the sources of this library. */
const char *carrier_checksum(void) { return CARRIER_CHECKSUM; }

/* Compares rcl_types.h with the headers of rcl, if they exist at the build. */

#if defined(__has_include) && __has_include("rcl/types.h")
#include "rcl/types.h"
#include "rcutils/error_handling.h"
#include "rcutils/types/uint8_array.h"
#include "rmw/types.h"

#define DIFFER(ours, our_field, theirs, their_field) (offsetof(ours, our_field) != offsetof(theirs, their_field))

bool rcl_types_differ(void) {
    return DIFFER(struct serialized_message, buffer, rcutils_uint8_array_t, buffer) ||
           DIFFER(struct serialized_message, length, rcutils_uint8_array_t, buffer_length) ||
           DIFFER(struct serialized_message, capacity, rcutils_uint8_array_t, buffer_capacity) ||
           DIFFER(struct serialized_message, allocator, rcutils_uint8_array_t, allocator) ||
           DIFFER(struct allocator, allocate, rcutils_allocator_t, allocate) ||
           DIFFER(struct allocator, deallocate, rcutils_allocator_t, deallocate) ||
           DIFFER(struct allocator, reallocate, rcutils_allocator_t, reallocate) ||
           DIFFER(struct allocator, zero_allocate, rcutils_allocator_t, zero_allocate) ||
           DIFFER(struct allocator, state, rcutils_allocator_t, state) ||
           DIFFER(struct message_info, source_timestamp, rmw_message_info_t, source_timestamp) ||
           DIFFER(struct message_info, received_timestamp, rmw_message_info_t, received_timestamp) ||
           DIFFER(struct message_info, publication_sequence_number, rmw_message_info_t, publication_sequence_number) ||
           DIFFER(struct message_info, publisher, rmw_message_info_t, publisher_gid.data) ||
           (int)GID_SIZE != RMW_GID_STORAGE_SIZE || sizeof(struct serialized_message) != sizeof(rcutils_uint8_array_t) ||
           sizeof(struct message_info) < sizeof(rmw_message_info_t) ||
           sizeof(struct error_text) != sizeof(rcutils_error_string_t) ||
           (int)TAKE_FAILED != RCL_RET_SUBSCRIPTION_TAKE_FAILED || NO_NUMBER != RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED;
}
#else
bool rcl_types_differ(void) { return false; }
#endif
