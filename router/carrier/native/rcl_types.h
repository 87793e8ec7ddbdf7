/* What is used of rcl. It has these types in C as well, but its headers need not be there where the library is made:
 * library.c compares them if they are, and router/ros/rcl.py tries them when the router starts. */
#ifndef RCL_TYPES_H
#define RCL_TYPES_H

#include <stdbool.h>
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

enum { GID_SIZE = 16 };
#define NO_NUMBER UINT64_MAX /* RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED */

/* rmw_message_info_t begins like this. Times of the wall clock, 0 where the middleware does not know. */
struct message_info {
    int64_t source_timestamp, received_timestamp;
    uint64_t publication_sequence_number, reception_sequence_number;
    const char *implementation;
    uint8_t publisher[GID_SIZE]; /* rmw_gid_t has these two */
    uint8_t rest[200];
};

/* rcutils_error_string_t */
struct error_text {
    char text[1024];
};

/* rcl_take_serialized_message: fills a serialized message and its info. Returns 0 if there was one. */
typedef int take_function(const void *subscription, void *message, void *info, void *allocation);

/* rcl_publish_serialized_message. Returns 0 if it has published. */
typedef int publish_function(const void *publisher, const void *message, void *allocation);

/* rcutils_get_error_string and rcutils_reset_error: what went wrong in the calling thread. */
typedef struct error_text error_function(void);
typedef void reset_function(void);

/* Whether the library was made beside headers of rcl that have something else. */
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
