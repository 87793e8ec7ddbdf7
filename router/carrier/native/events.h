/* Events of native threads for Python's log, as records of a ring. Ids stand for names that Python knows. Only so many are
 * written per window of time: the counter that an event names says how many there were. */
#ifndef EVENTS_H
#define EVENTS_H

#include <stdint.h>

enum event_kind { EVENT_TRIPPED = 1, EVENT_RELEASED, EVENT_DEADMAN_ERROR, EVENT_REJECTED, EVENT_LOST };

/* What every event begins with. */
struct event_head {
    uint32_t size, kind;
};

struct deadman_event {
    uint32_t size, kind;           /* EVENT_TRIPPED, EVENT_RELEASED or EVENT_DEADMAN_ERROR */
    uint32_t deadman, destination; /* `destination` only of an error */
    int32_t error;                 /* errno; 0 of an error whose text follows, up to a NUL */
    uint32_t counter;              /* of such errors */
};

struct rejected_event {
    uint32_t size, kind;      /* EVENT_REJECTED; the datagram follows, cut to MAX_DATAGRAM bytes */
    uint32_t listener, reason; /* enum reason */
    uint32_t address, port;   /* of the sender, host byte order */
    uint32_t length;          /* of the datagram */
    uint32_t counter;         /* of such rejections */
};

struct lost_event {
    uint32_t size, kind; /* EVENT_LOST; a text that says more may follow, up to a NUL */
    uint32_t route, topic, target; /* `topic`: of ROS, whose message it was, or NO_NAME */
    uint32_t reason;     /* enum loss */
    int32_t error;       /* errno, of LOSS_SEND_BUFFER_FULL and LOSS_SEND_ERROR */
    uint32_t counter;    /* of such losses */
    uint32_t generation; /* of the program, if a place in it refused the message: an enum place */
    uint32_t place;
};
#define NO_NAME UINT32_MAX

/* Where a routine refuses a message: `places` of a LoweredTarget in compiler/lowering. */
enum place {
    PLACE_MESSAGE,
    PLACE_CONDITION,
    PLACE_ROUTE,     /* `for_each` or `collect` */
    PLACE_OPERATIONS /* and the index of one */
};

/* Why a target did not get a message, by the names of DROP_REASONS in compiler/metrics.py. */
enum loss {
    LOSS_MAPPING_ERROR,
    LOSS_NON_FINITE,
    LOSS_STALE,
    LOSS_RATE_LIMITED,
    LOSS_QUEUE_FULL,
    LOSS_SEND_BUFFER_FULL,
    LOSS_SEND_ERROR,
    LOSS_PUBLISH_ERROR,
    LOSS_TOO_LARGE,
    LOSS_INCOMPLETE
};
enum { LOSSES = LOSS_INCOMPLETE + 1 };

#endif
