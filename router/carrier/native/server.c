#include "server.h"

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
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
#include "link.h"
#include "priority.h"
#include "tcp.h"
#include "threads.h"

enum { AGAIN_MS = 1000 /* from one attempt to listen to the next */ };

struct server {
    struct timers *timers;
    uint32_t host, port, listener, refused;
    int wake; /* eventfd: the server is to stop */
    pthread_t thread;
    _Atomic bool is_stopping;
    pthread_mutex_t lock; /* for the list; held only briefly */
    struct client *first;  /* the newest */
};

static void report_stranger(struct server *server, const struct sockaddr_in *from) {
    struct thread_env *env = server->timers->env;
    struct datagram_event event = {.kind = EVENT_REJECTED, .listener = server->listener, .reason = SOURCE_MISMATCH,
                                   .address = ntohl(from->sin_addr.s_addr), .port = ntohs(from->sin_port),
                                   .counter = server->refused};
    pthread_mutex_lock(&server->timers->lock);
    env_count(env, server->refused, 1);
    if (env->reporter.events) put_event(env->reporter.events, &event, sizeof event, "");
    pthread_mutex_unlock(&server->timers->lock);
}

static void welcome(struct server *server, int fd, const struct sockaddr_in *from) {
    pthread_mutex_lock(&server->lock);
    struct client *client = server->first;
    while (client && client->host != ntohl(from->sin_addr.s_addr)) client = client->next;
    if (client) link_offer(client->link, fd);
    pthread_mutex_unlock(&server->lock);
    if (client) return;
    tcp_abort(fd);
    report_stranger(server, from);
}

static void fail(struct server *server, int why) {
    pthread_mutex_lock(&server->lock);
    for (struct client *client = server->first; client; client = client->next) link_fail(client->link, why);
    pthread_mutex_unlock(&server->lock);
}

/* Wait until there is a connection, or the server is to stop, or for some time (ms; -1: no limit). */
static void await(struct server *server, int fd, int timeout) {
    struct pollfd waiting[] = {{server->wake, POLLIN, 0}, {fd, POLLIN, 0}};
    poll(waiting, 2, timeout);
}

static void *server_thread(void *of) {
    struct server *server = of;
    int fd = -1;
    while (!atomic_load(&server->is_stopping)) {
        if (fd < 0) fd = tcp_listen(server->host, server->port);
        if (fd < 0) fail(server, -fd);
        await(server, fd, fd < 0 ? AGAIN_MS : -1);
        if (fd < 0) continue;
        struct sockaddr_in from;
        socklen_t size = sizeof from;
        int accepted = accept4(fd, (struct sockaddr *)&from, &size, SOCK_NONBLOCK | SOCK_CLOEXEC);
        if (accepted >= 0) welcome(server, accepted, &from);
        else if (errno != EAGAIN && errno != ECONNABORTED) await(server, -1, AGAIN_MS); /* no descriptors */
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
