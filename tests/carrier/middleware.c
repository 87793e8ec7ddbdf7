/* A middleware for tests: messages that Python puts, and what is published. A library of its own. */
#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "rcl_types.h"

enum { MOST_MESSAGES = 4096, REFUSED = 1 };

struct queued {
    uint8_t *data;
    size_t size;
    int64_t sent, received;
};

struct subscription {
    pthread_mutex_t lock;
    pthread_cond_t changed;
    struct queued messages[MOST_MESSAGES];
    size_t first, count;
    bool is_stuck, refuses;
    int takers; /* that are inside now */
};

struct subscription *middleware_open(void) {
    struct subscription *made = calloc(1, sizeof *made);
    pthread_mutex_init(&made->lock, NULL);
    pthread_cond_init(&made->changed, NULL);
    return made;
}

void middleware_put(struct subscription *to, const void *data, size_t size, int64_t sent, int64_t received) {
    pthread_mutex_lock(&to->lock);
    struct queued *message = &to->messages[(to->first + to->count++) % MOST_MESSAGES];
    *message = (struct queued){malloc(size ? size : 1), size, sent, received};
    memcpy(message->data, data, size);
    pthread_mutex_unlock(&to->lock);
}

/* Have whoever takes wait, or go on. */
void middleware_set(struct subscription *of, bool is_stuck, bool refuses) {
    pthread_mutex_lock(&of->lock);
    of->is_stuck = is_stuck;
    of->refuses = refuses;
    pthread_cond_broadcast(&of->changed);
    pthread_mutex_unlock(&of->lock);
}

int middleware_takers(struct subscription *of) {
    pthread_mutex_lock(&of->lock);
    int takers = of->takers;
    pthread_mutex_unlock(&of->lock);
    return takers;
}

static int take_first(struct subscription *from, struct serialized_message *to, struct message_info *info) {
    if (from->refuses) return REFUSED;
    if (!from->count) return TAKE_FAILED;
    struct queued message = from->messages[from->first];
    from->first = (from->first + 1) % MOST_MESSAGES;
    from->count--;
    if (to) {
        if (to->capacity < message.size) {
            to->buffer = to->allocator.reallocate(to->buffer, message.size, to->allocator.state);
            to->capacity = message.size;
        }
        memcpy(to->buffer, message.data, message.size);
        to->length = message.size;
        info->source_timestamp = message.sent;
        info->received_timestamp = message.received;
    }
    free(message.data);
    return 0;
}

int middleware_take(struct subscription *from, struct serialized_message *to, struct message_info *info, void *unused) {
    (void)unused;
    pthread_mutex_lock(&from->lock);
    from->takers++;
    while (from->is_stuck) pthread_cond_wait(&from->changed, &from->lock);
    int error = take_first(from, to, info);
    from->takers--;
    pthread_mutex_unlock(&from->lock);
    return error;
}

void middleware_reset(void) {}

/* ---- publishers ---- */

struct publisher {
    pthread_mutex_t lock;
    pthread_cond_t changed;
    struct serialized_message messages[MOST_MESSAGES];
    size_t count;
    bool is_stuck;
    unsigned delay; /* us that each call takes */
    char refusal[1024]; /* why it refuses; empty if it does not */
    int callers; /* that are inside now */
};

static _Thread_local struct error_text last_error;

struct publisher *middleware_advertise(void) {
    struct publisher *made = calloc(1, sizeof *made);
    pthread_mutex_init(&made->lock, NULL);
    pthread_cond_init(&made->changed, NULL);
    return made;
}

/* Have whoever publishes wait, take its time, or be refused. */
void middleware_impede(struct publisher *of, bool is_stuck, unsigned delay, const char *refusal) {
    pthread_mutex_lock(&of->lock);
    of->is_stuck = is_stuck;
    of->delay = delay;
    snprintf(of->refusal, sizeof of->refusal, "%s", refusal);
    pthread_cond_broadcast(&of->changed);
    pthread_mutex_unlock(&of->lock);
}

int middleware_callers(struct publisher *of) {
    pthread_mutex_lock(&of->lock);
    int callers = of->callers;
    pthread_mutex_unlock(&of->lock);
    return callers;
}

size_t middleware_count(struct publisher *of) {
    pthread_mutex_lock(&of->lock);
    size_t count = of->count;
    pthread_mutex_unlock(&of->lock);
    return count;
}

/* Message `index` of those that were published. */
const struct serialized_message *middleware_message(struct publisher *of, size_t index) { return &of->messages[index]; }

int middleware_publish(struct publisher *to, const struct serialized_message *message, void *unused) {
    (void)unused;
    pthread_mutex_lock(&to->lock);
    to->callers++;
    while (to->is_stuck) pthread_cond_wait(&to->changed, &to->lock);
    unsigned delay = to->delay;
    pthread_mutex_unlock(&to->lock);
    if (delay) usleep(delay);
    pthread_mutex_lock(&to->lock);
    bool is_refused = to->refusal[0] || to->count == MOST_MESSAGES;
    if (is_refused) {
        memcpy(last_error.text, to->refusal, sizeof last_error.text);
    } else {
        uint8_t *copy = malloc(message->length);
        memcpy(copy, message->buffer, message->length);
        to->messages[to->count++] = (struct serialized_message){.buffer = copy, .length = message->length};
    }
    to->callers--;
    pthread_mutex_unlock(&to->lock);
    return is_refused ? REFUSED : 0;
}

struct error_text middleware_error(void) { return last_error; }

void middleware_forget_error(void) { last_error.text[0] = 0; }
