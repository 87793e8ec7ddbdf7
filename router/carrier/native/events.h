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

/* What shows that a loss is right, with numbers in `values` of a struct refusal. Those with a text have its beginning behind
 * the event. */
enum refused {
    REFUSED_UNTOLD,
    /* Values of a mapping: */
    REFUSED_MALFORMED, /* the message, or an element of a list */
    REFUSED_INTEGER,   /* not between two bounds; `flags` (enum sign) say which of the three are unsigned */
    REFUSED_OVERFLOW,  /* a result of integers */
    REFUSED_DIVISION,  /* by zero */
    REFUSED_BOUNDS,    /* a low bound above the high one; likewise */
    REFUSED_RESULT,    /* of a function, which has none; `flags` 1: the bits of its real argument */
    REFUSED_REAL,      /* the bits of a real number that is no integer, or none of 64 bits */
    REFUSED_FLOAT32,   /* those of one that is infinite as a float32 */
    REFUSED_SIZE,      /* bytes of a text or of bytes, and the most */
    REFUSED_UTF8,      /* the number of bytes, and a text */
    REFUSED_NUL,       /* likewise, the text up to its first NUL */
    REFUSED_NAME,      /* of no value of an enum, likewise */
    REFUSED_MEMBER,    /* a number of no value of an enum */
    REFUSED_ELEMENT,   /* an index, and how many elements there are */
    REFUSED_COUNT,     /* elements, and how many there have to be */
    REFUSED_MOST,      /* elements, and the most */
    REFUSED_LENGTHS,   /* elements of two lists side by side */
    REFUSED_WORK,      /* more turns of loops than a message may take */
    REFUSED_ROOM,      /* more cells or text than it may take, or a message that is too large to write */
    /* Ages: how old the message is and `ttl`, in ns. */
    REFUSED_ARRIVAL, /* since it arrived here */
    REFUSED_SENDING, /* since it was sent by its sender's clock */
    REFUSED_STAMP,   /* by its own stamp */
    REFUSED_WAITING  /* at the latest when it could leave */
};

struct refusal {
    uint32_t kind; /* enum refused */
    uint32_t flags;
    int64_t values[3];
};

struct lost_event {
    uint32_t size, kind; /* EVENT_LOST; a text that says more may follow, up to a NUL */
    uint32_t route, topic, target; /* `topic`: of ROS, whose message it was, or NO_NAME */
    uint32_t reason;     /* enum loss */
    int32_t error;       /* errno, of LOSS_SEND_BUFFER_FULL and LOSS_SEND_ERROR */
    uint32_t counter;    /* of such losses */
    uint32_t generation; /* of the program, if a place in it refused the message: an enum place */
    uint32_t place;
    struct refusal refusal;
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
