#include "server.h"

#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "counters.h"
#include "deliver.h"
#include "envelope.h"
#include "events.h"
#include "hosts.h"
#include "link.h"
#include "priority.h"
#include "tcp.h"
#include "threads.h"

enum { AGAIN_MS = 1000 /* from one attempt to listen, or look at the network interface, to the next */ };

struct server {
    struct timers *timers;
    uint32_t host, port, listener, refused;
    int wake; /* eventfd: the server is to stop */
    pthread_t thread;
    _Atomic bool is_stopping;
    pthread_mutex_t lock; /* for the list; held only briefly */
    struct client *first;  /* the newest */
};

static void report_stranger(struct server *server, const union socket_address *from) {
    struct thread_env *env = server->timers->env;
    struct datagram_event event = {.kind = EVENT_REJECTED, .listener = server->listener, .reason = SOURCE_MISMATCH,
                                   .address = host_number(from), .port = host_port(from),
                                   .counter = server->refused};
    pthread_mutex_lock(&server->timers->lock);
    env_count(env, server->refused, 1);
    if (env->reporter.events) put_event(env->reporter.events, &event, sizeof event, "");
    pthread_mutex_unlock(&server->timers->lock);
}

static void welcome(struct server *server, int fd, const union socket_address *from) {
    pthread_mutex_lock(&server->lock);
    uint32_t host = host_number(from); /* a reload may know another address of this number before it joins */
    struct client *client = server->first;
    while (client && client->host != host) client = client->next;
    if (client) link_offer(client->link, fd);
    pthread_mutex_unlock(&server->lock);
    if (client) return;
    tcp_abort(fd);
    report_stranger(server, from);
}

/* Report why the clients are not connected. */
static void report(struct server *server, int why) {
    pthread_mutex_lock(&server->lock);
    for (struct client *client = server->first; client; client = client->next) link_fail(client->link, why);
    pthread_mutex_unlock(&server->lock);
}

/* Wait until there is a connection, or the server is to stop, or for some time. */
static void await(struct server *server, int fd) {
    struct pollfd waiting[] = {{server->wake, POLLIN, 0}, {fd, POLLIN, 0}};
    poll(waiting, 2, AGAIN_MS);
}

/* Return the descriptor, or another one if it is not at the present network interface. */
static int listen_again(struct server *server, int fd) {
    if (fd >= 0 && tcp_is_at(fd, server->host)) return fd;
    if (fd >= 0) close(fd);
    fd = tcp_listen(server->host, server->port);
    report(server, fd < 0 ? -fd : ENOTCONN);
    return fd;
}

static void *server_thread(void *of) {
    struct server *server = of;
    int fd = -1;
    while (!atomic_load(&server->is_stopping)) {
        fd = listen_again(server, fd);
        await(server, fd);
        if (fd < 0) continue;
        union socket_address from;
        socklen_t size = sizeof from;
        int accepted = accept4(fd, &from.any, &size, SOCK_NONBLOCK | SOCK_CLOEXEC);
        if (accepted >= 0) welcome(server, accepted, &from);
        else if (errno != EAGAIN && errno != ECONNABORTED) await(server, -1); /* no descriptors */
    }
    if (fd >= 0) close(fd);
    return NULL;
}

static void release(struct server *server) {
    if (server->wake >= 0) close(server->wake);
    pthread_mutex_destroy(&server->lock);
    free(server);
}

struct server *server_open(struct timers *timers, uint32_t host, uint32_t port, uint32_t listener, uint32_t refused) {
    struct server *server = calloc(1, sizeof *server);
    if (!server || lock_open(&server->lock)) {
        free(server);
        return NULL;
    }
    server->timers = timers;
    server->host = host;
    server->port = port;
    server->listener = listener;
    server->refused = refused;
    server->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (server->wake < 0 || thread_start(&server->thread, "server", server_thread, server)) {
        release(server);
        return NULL;
    }
    return server;
}

void server_stop(struct server *server) {
    if (atomic_exchange(&server->is_stopping, true)) return;
    eventfd_write(server->wake, 1);
    pthread_join(server->thread, NULL);
}

void server_close(struct server *server) {
    server_stop(server);
    release(server);
}

void server_join(struct server *server, struct client *client) {
    pthread_mutex_lock(&server->lock);
    client->next = server->first;
    server->first = client;
    pthread_mutex_unlock(&server->lock);
}

void server_leave(struct server *server, struct client *client) {
    pthread_mutex_lock(&server->lock);
    struct client **at = &server->first;
    while (*at && *at != client) at = &(*at)->next;
    if (*at) *at = client->next;
    pthread_mutex_unlock(&server->lock);
}
