/* What rcl_take_serialized_message fills, as far as it is used here. rcl has these types in C as well, but its headers are
 * not there where the library is built; tests/carrier/test_commands.py compares them. */
#ifndef RCL_TYPES_H
#define RCL_TYPES_H

#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

enum { TAKE_FAILED = 401 }; /* RCL_RET_SUBSCRIPTION_TAKE_FAILED: there is no message */

/* rcutils_allocator_t */
struct allocator {
    void *(*allocate)(size_t size, void *state);
    void (*deallocate)(void *memory, void *state);
    void *(*reallocate)(void *memory, size_t size, void *state);
    void *(*zero_allocate)(size_t count, size_t size, void *state);
    void *state;
};

/* rcutils_uint8_array_t. Taking makes the buffer larger where that is necessary, and never smaller. */
struct serialized_message {
    uint8_t *buffer;
    size_t length, capacity;
    struct allocator allocator;
};

/* rmw_message_info_t begins like this. Times of the wall clock, 0 where the middleware does not know. */
struct message_info {
    int64_t source_timestamp, received_timestamp;
    uint8_t rest[240];
};

static inline void *allocate(size_t size, void *state) {
    (void)state;
    return malloc(size);
}

static inline void deallocate(void *memory, void *state) {
    (void)state;
    free(memory);
}

static inline void *reallocate(void *memory, size_t size, void *state) {
    (void)state;
    return realloc(memory, size);
}

static inline void *zero_allocate(size_t count, size_t size, void *state) {
    (void)state;
    return calloc(count, size);
}

static const struct allocator ALLOCATOR = {allocate, deallocate, reallocate, zero_allocate, NULL};

#endif
