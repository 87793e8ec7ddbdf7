/* The types and functions of rcl that the library uses, declared here because rcl's headers may be missing at the build:
 * library.c compares the two if they exist, and router/ros/rcl.py checks them when the router starts. */
#ifndef RCL_TYPES_H
#define RCL_TYPES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

enum { TAKE_FAILED = 401 }; /* RCL_RET_SUBSCRIPTION_TAKE_FAILED: no message */

/* rcutils_allocator_t */
struct allocator {
    void *(*allocate)(size_t size, void *state);
    void (*deallocate)(void *memory, void *state);
    void *(*reallocate)(void *memory, size_t size, void *state);
    void *(*zero_allocate)(size_t count, size_t size, void *state);
    void *state;
};

/* rcutils_uint8_array_t. Taking enlarges the buffer if necessary, and never shrinks it. */
struct serialized_message {
    uint8_t *buffer;
    size_t length, capacity;
    struct allocator allocator;
};

enum { GID_SIZE = 16 };
#define NO_NUMBER UINT64_MAX /* RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED */

/* The beginning of rmw_message_info_t. Times are on the wall clock, 0 if unknown to the middleware. */
struct message_info {
    int64_t source_timestamp, received_timestamp;
    uint64_t publication_sequence_number, reception_sequence_number;
    const char *implementation;
    uint8_t publisher[GID_SIZE]; /* this and the next one are rmw_gid_t */
    uint8_t rest[200];
};

/* rcutils_error_string_t */
struct error_text {
    char text[1024];
};

/* rcl_take_serialized_message: fills a serialized message and its info. Returns 0 if there was one. */
typedef int take_function(const void *subscription, void *message, void *info, void *allocation);

/* rcl_publish_serialized_message. Returns 0 on success. */
typedef int publish_function(const void *publisher, const void *message, void *allocation);

/* rcutils_get_error_string and rcutils_reset_error: the last error of the calling thread. */
typedef struct error_text error_function(void);
typedef void reset_function(void);

/* Whether the library was built with headers of rcl that differ. */
bool rcl_types_differ(void);

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
