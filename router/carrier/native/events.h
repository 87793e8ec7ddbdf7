/* Events of native threads for Python's log, as records of a ring. Ids stand for names, which Python looks up. The rate of
 * events is limited: the counter that an event names has the full number. */
#ifndef EVENTS_H
#define EVENTS_H

#include <stdint.h>

enum event_kind {
    EVENT_TRIPPED = 1,
    EVENT_RELEASED,
    EVENT_DEADMAN_ERROR,
    EVENT_REJECTED,
    EVENT_SUPERSEDED,
    EVENT_LOST,
    EVENT_OBEYED,
    EVENT_DISOBEYED,
    EVENT_EVIDENCE,
    EVENT_RETURNED,
    EVENT_STATE,
    EVENT_LINK,
    EVENT_LEARNED,
    EVENT_REPLY
};

/* The beginning of every event. */
struct event_head {
    uint32_t size, kind;
};

struct deadman_event {
    uint32_t size, kind;           /* EVENT_TRIPPED, EVENT_RELEASED or EVENT_DEADMAN_ERROR */
    uint32_t deadman, destination; /* `destination`: for errors only */
    int32_t error;                 /* errno; 0 if a text follows, up to a NUL */
    uint32_t counter;              /* of such errors */
};

/* Whether a destination obeys the brake of a deadman. EVENT_EVIDENCE: what it has sent instead; the datagram follows. */
struct answer_event {
    uint32_t size, kind; /* EVENT_OBEYED, EVENT_DISOBEYED or EVENT_EVIDENCE */
    uint32_t deadman, destination;
    int64_t after;       /* ns since the deadman tripped; for evidence, the length of the datagram */
};

struct datagram_event {
    uint32_t size, kind;      /* EVENT_REJECTED or EVENT_SUPERSEDED; the datagram follows, cut to MAX_DATAGRAM bytes */
    uint32_t listener, reason; /* enum reason, if it was rejected */
    uint32_t address, port;   /* of the sender, host byte order */
    uint32_t length;          /* of the datagram */
    uint32_t counter;         /* of such rejections, or of superseded payloads */
};

struct returned_event {
    uint32_t size, kind; /* EVENT_RETURNED: an endpoint is heard again */
    uint32_t endpoint, reserved;
    int64_t silence;     /* ns */
};

struct learned_event {
    uint32_t size, kind;     /* EVENT_LEARNED: the address of an endpoint was learned, or a reload has excluded it */
    uint32_t endpoint, reserved;
    uint64_t before, after;  /* as in struct learned_peer */
};

enum { STATE_WORDS = 4, MOST_STATE_TEXT = STATE_WORDS * 8 }; /* bytes of a text */

/* The value of a state: a number, or a text of `number` bytes with zeros after them. */
struct state_content {
    int64_t number;
    uint8_t text[MOST_STATE_TEXT];
};

struct state_event {
    uint32_t size, kind;    /* EVENT_STATE: the value of a state has changed */
    uint32_t state, source; /* `source`: the sender that set it, or NO_NAME: it has expired, or a reload has changed it */
    uint32_t is_text, reserved;
    struct state_content before, after;
};

struct link_event {
    uint32_t size, kind; /* EVENT_LINK: a link was opened, was closed, or cannot be opened */
    uint32_t endpoint;   /* at its other end */
    int32_t error;       /* errno: why it is closed; 0 if it is open */
};

struct reply_event {
    uint32_t size, kind;     /* EVENT_REPLY: a reply for a service; the message follows */
    uint32_t target, length; /* `target`: as in other events; `length`: of the message */
};

/* Details of a loss, with numbers in `values` of a struct refusal. If there is a text, its beginning follows the event. */
enum refused {
    REFUSED_UNTOLD,
    /* Values of a mapping: */
    REFUSED_MALFORMED, /* the message, or an element of a list */
    REFUSED_INTEGER,   /* not between two bounds; `flags` (enum sign) say which of the three are unsigned */
    REFUSED_OVERFLOW,  /* a result of integers */
    REFUSED_DIVISION,  /* by zero */
    REFUSED_BOUNDS,    /* a low bound above the high one; flags likewise */
    REFUSED_RESULT,    /* a function has no result; `flags` 1: the bits of its real argument */
    REFUSED_REAL,      /* the bits of a real number that is not an integer, or not one of 64 bits */
    REFUSED_FLOAT32,   /* the bits of a real number that is infinite as a float32 */
    REFUSED_SIZE,      /* the size of a text or bytes, and the largest allowed one */
    REFUSED_UTF8,      /* the number of bytes, and a text */
    REFUSED_NUL,       /* likewise, the text up to its first NUL */
    REFUSED_NAME,      /* likewise, a name that the enum lacks */
    REFUSED_MEMBER,    /* a number that the enum lacks */
    REFUSED_ELEMENT,   /* an index, and the number of elements */
    REFUSED_COUNT,     /* the number of elements, and the required number */
    REFUSED_MOST,      /* the number of elements, and the largest allowed one */
    REFUSED_LENGTHS,   /* the numbers of elements of two parallel lists */
    REFUSED_WORK,      /* more loop iterations than a message may take */
    REFUSED_ROOM,      /* more cells or text than it may take, or a message that is too large to write */
    /* Ages: the age of the message and `ttl`, in ns. */
    REFUSED_ARRIVAL, /* age since arrival */
    REFUSED_SENDING, /* age since sending, by the sender's clock */
    REFUSED_STAMP,   /* age by its own stamp */
    REFUSED_WAITING, /* age at the time when it could be sent */
    /* Numbers of `order`: of the datagram, and the highest one of its sender; flags say which are unsigned. */
    REFUSED_ORDER
};

struct refusal {
    uint32_t kind; /* enum refused */
    uint32_t flags;
    int64_t values[3];
};

struct lost_event {
    uint32_t size, kind; /* EVENT_LOST; a text with details may follow, up to a NUL */
    uint32_t route, topic, target; /* `topic`: of the message from ROS, or NO_NAME */
    uint32_t reason;     /* enum drop_reason */
    int32_t error;       /* errno, of DROP_SEND_BUFFER_FULL and DROP_SEND_ERROR */
    uint32_t counter;    /* of such losses */
    uint32_t generation; /* of the program, if `place` in it refused the message */
    uint32_t place;
    struct refusal refusal;
};
#define NO_NAME UINT32_MAX

/* Where a routine refuses a message: `places` of a Target in compiler/checked.py. */
enum place {
    PLACE_MESSAGE,
    PLACE_CONDITION,
    PLACE_COLLECT,
    PLACE_FOR_EACH,
    PLACE_OPERATIONS /* plus the index of an operation */
};
#define PLACE_ORDER UINT32_MAX /* `order`, for all targets of a route */

/* Why a target did not get a message: DROP_REASONS in compiler/metrics.py. */
enum drop_reason {
    DROP_MAPPING_ERROR,
    DROP_NON_FINITE,
    DROP_STALE,
    DROP_RATE_LIMITED,
    DROP_QUEUE_FULL,
    DROP_SEND_BUFFER_FULL,
    DROP_SEND_ERROR,
    DROP_PUBLISH_ERROR,
    DROP_TOO_LARGE,
    DROP_INCOMPLETE,
    DROP_SUPERSEDED,
    DROP_MISSING_FIELD,
    DROP_OUT_OF_ORDER
};
enum { DROP_REASONS = DROP_OUT_OF_ORDER + 1 };

#endif
