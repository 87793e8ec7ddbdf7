/* A TCP server for links: each accepted connection becomes the stream of the link whose other end has that IP address.
 * Connections from other addresses are closed, counted and reported. */
#ifndef SERVER_H
#define SERVER_H

#include <stdint.h>

#include "timers.h"

struct link;
struct server;

/* A link in the list of its server. */
struct client {
    struct client *next;
    struct link *link;
    uint32_t host;
};

/* Listen, again each second while that fails. `listener` identifies the server in events, `refused` is the counter of the
 * group for connections from other addresses. Returns NULL if memory, descriptors or threads run out. */
struct server *server_open(struct timers *timers, uint32_t host, uint32_t port, uint32_t listener, uint32_t refused);

/* Stop listening, and end the thread. May be called again. */
void server_stop(struct server *server);

/* Stop it and free it, once all links have left. */
void server_close(struct server *server);

/* Offer connections from the client's host to its link from now on, rather than to links that joined before; offer none. */
void server_join(struct server *server, struct client *client);
void server_leave(struct server *server, struct client *client);

#endif
