#include "tcp.h"

#include <errno.h>
#include <linux/sockios.h>
#include <linux/tcp.h> /* struct tcp_info of <netinet/tcp.h> is older */
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include "hosts.h"

enum { CONNECTING_MS = 1000, PROBE_AFTER = 1 /* s */, WAITING_CLIENTS = 128 };

static void set(int fd, int level, int option, int value) { setsockopt(fd, level, option, &value, sizeof value); }

/* Write the address, and open a socket of its family. Return a negative errno on failure. */
static int tcp_socket(uint32_t host, uint32_t port, union socket_address *address, socklen_t *size) {
    *size = host_address(host, (uint16_t)port, address);
    if (!*size) return -EADDRNOTAVAIL;
    bool is_v6 = address->any.sa_family == AF_INET6;
    if (is_v6 && IN6_IS_ADDR_LINKLOCAL(&address->v6.sin6_addr) && !address->v6.sin6_scope_id) return -ENONET;
    int fd = socket(address->any.sa_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (fd < 0) return -errno;
    if (is_v6) set(fd, IPPROTO_IPV6, IPV6_V6ONLY, 1);
    return fd;
}

/* Return 0, or the errno of an attempt to connect. */
static int await_connection(int fd, int wake) {
    struct pollfd waiting[] = {{fd, POLLOUT, 0}, {wake, POLLIN, 0}};
    int error = ETIMEDOUT;
    socklen_t size = sizeof error;
    if (poll(waiting, 2, CONNECTING_MS) < 0) return errno;
    if (waiting[0].revents) getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &size);
    return error;
}

int tcp_connect(uint32_t host, uint32_t port, uint32_t patience, int wake) {
    union socket_address to;
    socklen_t size;
    int fd = tcp_socket(host, port, &to, &size);
    if (fd < 0) return fd;
    tcp_settle(fd, patience);
    int error = connect(fd, &to.any, size) ? errno : 0;
    if (error == EINPROGRESS) error = await_connection(fd, wake);
    if (!error) return fd;
    close(fd);
    return -error;
}

int tcp_listen(uint32_t host, uint32_t port) {
    union socket_address at;
    socklen_t size;
    int fd = tcp_socket(host, port, &at, &size);
    if (fd < 0) return fd;
    set(fd, SOL_SOCKET, SO_REUSEADDR, 1); /* connections of an earlier router may still be closing */
    if (!bind(fd, &at.any, size) && !listen(fd, WAITING_CLIENTS)) return fd;
    int error = errno;
    close(fd);
    return -error;
}

bool tcp_is_at(int fd, uint32_t host) {
    union socket_address bound, now;
    socklen_t size = sizeof bound;
    if (getsockname(fd, &bound.any, &size) || !host_address(host, 0, &now) || now.any.sa_family != AF_INET6) return true;
    return bound.v6.sin6_scope_id == now.v6.sin6_scope_id;
}

void tcp_settle(int fd, uint32_t patience) {
    set(fd, IPPROTO_TCP, TCP_NODELAY, 1);
    set(fd, IPPROTO_TCP, TCP_USER_TIMEOUT, (int)patience);
    set(fd, SOL_SOCKET, SO_KEEPALIVE, 1);
    set(fd, IPPROTO_TCP, TCP_KEEPIDLE, PROBE_AFTER);
    set(fd, IPPROTO_TCP, TCP_KEEPINTVL, PROBE_AFTER);
}

int64_t tcp_unacknowledged(int fd, struct tcp_watch *watch, int64_t now) {
    struct tcp_info info;
    socklen_t size = sizeof info;
    int waiting;
    if (ioctl(fd, SIOCOUTQ, &waiting) || getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &size)) waiting = 0;
    if (!waiting || info.tcpi_bytes_acked != watch->acknowledged) {
        watch->acknowledged = waiting ? info.tcpi_bytes_acked : 0;
        watch->since = now;
    }
    return now - watch->since;
}

int tcp_waiting(int fd) {
    int waiting;
    return ioctl(fd, SIOCOUTQNSD, &waiting) ? 0 : waiting;
}

void tcp_abort(int fd) {
    struct linger at_once = {.l_onoff = 1, .l_linger = 0};
    setsockopt(fd, SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
    close(fd);
}
