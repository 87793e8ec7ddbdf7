#include "client_deadmen.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "clock.h"
#include "deliver.h"
#include "priority.h"
#include "threads.h"

struct client_deadmen {
    struct thread_env env; /* first: `brake` gets a pointer to it */
    struct timers *group;
    pthread_t thread;
    pthread_cond_t changed;
    bool has_started, has_stopped; /* for the thread that starts and stops it */
    bool has_ended;                /* under the lock of the group */
    int wake;                      /* eventfd */
    _Atomic bool is_stopping;
    _Atomic uint32_t latest; /* generation */
    /* Written by the thread: */
    _Atomic uint32_t generation; /* nothing of an earlier one is in use */
    struct publishing publishing;
    /* For the thread: */
    bool has_message;              /* the machine's output is the message of a served deadman */
    struct deadman_destination to; /* its destination; `datagrams` is not used, as the deadman may be closed */
};

/* ---- with the lock held ---- */

/* Keep the only datagram of a deadman as the output of the machine. Only one deadman is served at a time. */
static int keep_message(struct thread_env *env, const struct deadman_destination *to,
                        const struct deadman_datagram *datagram) {
    struct client_deadmen *of = (struct client_deadmen *)env;
    env->machine.output.size = 0;
    if (!append(&env->machine.output, datagram->data, datagram->size)) return ENOMEM;
    of->to = *to;
    of->has_message = true;
    return BRAKE_LATER;
}

/* Publish the kept datagram of a deadman, with the lock released meanwhile. */
static void publish_message(struct client_deadmen *of, struct timer *from) {
    of->has_message = false;
    const char *why = publish_unlocked(&of->publishing, &of->group->lock, of->to.publisher, of->to.id,
                                       &of->env.machine.output);
    if (!of->group->is_abandoned) deadman_settle(of->group, from, &of->to, why, boottime_ns());
}

static struct timer *find_due(const struct timers *group, int64_t now) {
    for (struct timer *each = group->first; each; each = each->next)
        if (each->due <= now) return each;
    return NULL;
}

/* Serve each deadman that is due now, once. One that is fed while another one publishes is no longer due. */
static void serve_all(struct client_deadmen *of) {
    int64_t now = boottime_ns();
    struct timer *due;
    while (!of->group->is_abandoned && (due = find_due(of->group, now))) {
        due->kind->serve(of->group, due, boottime_ns());
        if (of->has_message) publish_message(of, due);
    }
}

static void end_all(struct client_deadmen *of) {
    for (struct timer *each = of->group->first; each; each = each->next) deadman_schedule_end(of->group, each);
}

/* ---- the thread ---- */

static void wait_for_more(struct client_deadmen *of) {
    struct pollfd waiting[] = {{of->group->timer, POLLIN, 0}, {of->wake, POLLIN, 0}};
    eventfd_t ignored;
    timers_await_next(of->group);
    pthread_mutex_unlock(&of->group->lock);
    poll(waiting, 2, -1);
    if (waiting[1].revents) eventfd_read(of->wake, &ignored);
    pthread_mutex_lock(&of->group->lock);
}

static void *run(void *argument) {
    struct client_deadmen *of = argument;
    run_soon();
    pthread_mutex_lock(&of->group->lock);
    for (;;) {
        uint32_t latest = atomic_load(&of->latest);
        bool is_stopping = atomic_load(&of->is_stopping);
        if (is_stopping) end_all(of);
        serve_all(of);
        if (of->group->is_abandoned || is_stopping) break;
        atomic_store(&of->generation, latest);
        wait_for_more(of);
    }
    of->has_ended = true;
    pthread_cond_broadcast(&of->changed);
    pthread_mutex_unlock(&of->group->lock);
    return NULL;
}

/* ---- public ---- */

static void wake_up(struct client_deadmen *of) { eventfd_write(of->wake, 1); }

struct client_deadmen *client_deadmen_open(counter *counters, struct ring *events) {
    struct client_deadmen *of = calloc(1, sizeof *of);
    if (!of) return NULL;
    bool is_open = env_open(&of->env, counters, events, NULL);
    of->env.brake = keep_message;
    of->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    of->group = is_open && of->wake >= 0 ? timers_open_on(&of->env, true) : NULL;
    condition_open(&of->changed);
    if (of->group) return of;
    pthread_cond_destroy(&of->changed);
    if (of->wake >= 0) close(of->wake);
    env_close(&of->env);
    free(of);
    return NULL;
}

struct timers *client_deadmen_group(struct client_deadmen *of) { return of->group; }

int client_deadmen_start(struct client_deadmen *of, publish_function *publish, error_function *error,
                         reset_function *reset) {
    of->publishing.publish = publish;
    of->publishing.error = error;
    of->publishing.reset = reset;
    int failed = thread_start(&of->thread, "client deadmen", run, of);
    of->has_started = !failed;
    return failed;
}

void client_deadmen_advance(struct client_deadmen *of, uint32_t generation) {
    atomic_store(&of->latest, generation);
    wake_up(of);
}

bool client_deadmen_have_reached(struct client_deadmen *of, uint32_t generation) {
    return atomic_load(&of->generation) >= generation;
}

int64_t client_deadmen_since(struct client_deadmen *of, uint32_t *topic) {
    return publishing_since(&of->publishing, topic);
}

bool client_deadmen_stop(struct client_deadmen *of) {
    if (!of->has_started || of->has_stopped) return !of->group->is_abandoned;
    of->has_stopped = true;
    atomic_store(&of->is_stopping, true);
    wake_up(of);
    return thread_end(of->thread, &of->group->lock, &of->changed, &of->has_ended, &of->group->is_abandoned);
}
