#include "sender.h"

#include <errno.h>
#include <limits.h>
#include <netinet/icmp6.h>
#include <netinet/ip_icmp.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

#include <linux/errqueue.h> /* needs time.h */

#include "hosts.h"
#include "link.h"

enum { MOST_ERRORS = 32 }; /* read at once */

static pthread_mutex_t list_lock = PTHREAD_MUTEX_INITIALIZER; /* held only briefly */
static struct sender *first;

/* An address and port as one word: the first bytes of a struct sockaddr_in. For IPv6 the number of the host is in the place
 * of its address. */
struct aim {
    sa_family_t family;
    in_port_t port;  /* network byte order */
    uint32_t number; /* IPv4: network byte order */
};

_Static_assert(sizeof(struct aim) == sizeof(uint64_t) && offsetof(struct sockaddr_in, sin_addr) == offsetof(struct aim, number),
               "an address with its port is one word");

static uint64_t packed(uint32_t number, uint16_t port) {
    bool is_v6 = host_is_ipv6(number);
    struct aim aim = {is_v6 ? AF_INET6 : AF_INET, htons(port), is_v6 ? number : htonl(number)};
    uint64_t word;
    memcpy(&word, &aim, sizeof word);
    return word;
}

/* Write the address of a word other than 0. Return its size, or 0 if it is not known. */
static inline socklen_t unpacked(uint64_t word, union socket_address *to) {
    struct aim aim;
    memcpy(&aim, &word, sizeof aim);
    if (aim.family == AF_INET6) return host_address(aim.number, ntohs(aim.port), to);
    to->v4 = (struct sockaddr_in){0};
    memcpy(&to->v4, &word, sizeof word);
    return sizeof to->v4;
}

void sender_aim(struct sender *sender, uint32_t address, uint16_t port) {
    uint64_t word = address ? packed(address, port) : 0;
    if (atomic_exchange(&sender->to, word) != word) sender_take_refused(sender);
}

struct sender *sender_open(int fd, int listener, uint32_t address, uint16_t port) {
    struct sender *sender = calloc(1, sizeof *sender);
    if (!sender) return NULL;
    sender_aim(sender, address, port);
    sender_move(sender, fd, listener);
    pthread_mutex_lock(&list_lock);
    sender->next = first;
    first = sender;
    pthread_mutex_unlock(&list_lock);
    return sender;
}

void sender_move(struct sender *sender, int fd, int listener) {
    atomic_store(&sender->fd, fd);
    atomic_store(&sender->listener, listener);
}

void sender_on_link(struct sender *sender, struct link *link) {
    sender->link = link;
    sender_move(sender, -1, -1);
}

void sender_end(struct sender *sender) { sender_move(sender, -1, -1); }

void sender_close(struct sender *sender) {
    pthread_mutex_lock(&list_lock);
    struct sender **link = &first;
    while (*link != sender) link = &(*link)->next;
    *link = sender->next;
    pthread_mutex_unlock(&list_lock);
    free(sender);
}

/* ---- errors of earlier datagrams ---- */

/* Whether the receiver has refused a datagram. Routers also report temporary problems, and this computer reports that ARP is
 * not answered: these say nothing about the next datagram. */
static bool is_refusal(const struct sock_extended_err *error) {
    if (error->ee_origin == SO_EE_ORIGIN_ICMP6)
        return error->ee_type == ICMP6_DST_UNREACH && error->ee_code != ICMP6_DST_UNREACH_NOROUTE &&
               error->ee_code != ICMP6_DST_UNREACH_ADDR;
    if (error->ee_origin != SO_EE_ORIGIN_ICMP || error->ee_type != ICMP_DEST_UNREACH) return false;
    return error->ee_code != ICMP_NET_UNREACH && error->ee_code != ICMP_HOST_UNREACH;
}

/* Read an error of a socket. Return whether there was one. `refused` is set to its errno, or 0 if it is not a refusal;
 * `address` is set to that of the datagram. */
static bool read_error(int fd, union socket_address *address, int *refused) {
    union { struct cmsghdr aligned; char bytes[256]; } control;
    char byte; /* of the datagram: without a buffer, qemu-user reads nothing but reports success */
    struct iovec into = {&byte, sizeof byte};
    struct msghdr message = {.msg_name = address, .msg_namelen = sizeof *address, .msg_iov = &into, .msg_iovlen = 1,
                             .msg_control = &control, .msg_controllen = sizeof control};
    if (recvmsg(fd, &message, MSG_ERRQUEUE | MSG_DONTWAIT) < 0) return false;
    *refused = 0;
    for (struct cmsghdr *each = CMSG_FIRSTHDR(&message); each; each = CMSG_NXTHDR(&message, each)) {
        bool is_v4 = each->cmsg_level == IPPROTO_IP && each->cmsg_type == IP_RECVERR;
        if (!is_v4 && (each->cmsg_level != IPPROTO_IPV6 || each->cmsg_type != IPV6_RECVERR)) continue;
        struct sock_extended_err error;
        memcpy(&error, CMSG_DATA(each), sizeof error);
        if (is_refusal(&error)) *refused = (int)error.ee_errno;
    }
    return true;
}

/* Discard errors, which share the memory of the receive buffer: those of a flood would keep datagrams out. */
static void discard_errors(int fd) {
    int family;
    socklen_t size = sizeof family;
    if (getsockopt(fd, SOL_SOCKET, SO_DOMAIN, &family, &size)) return;
    bool is_v6 = family == AF_INET6;
    for (int wanted = 0; wanted <= 1; wanted++)
        setsockopt(fd, is_v6 ? IPPROTO_IPV6 : IPPROTO_IP, is_v6 ? IPV6_RECVERR : IP_RECVERR, &wanted, sizeof wanted);
}

/* Record an error. Return false if the sender already has one: it keeps one at a time. */
static bool note(struct sender *sender, int refused) {
    int none = 0;
    return atomic_compare_exchange_strong(&sender->refused, &none, refused);
}

/* Record an error for the first sender to the address that has none yet. */
static void note_by_address(const union socket_address *address, int refused) {
    uint64_t to = packed(host_number(address), host_port(address));
    pthread_mutex_lock(&list_lock);
    for (struct sender *each = first; each; each = each->next)
        if (atomic_load_explicit(&each->to, memory_order_relaxed) == to && note(each, refused)) break;
    pthread_mutex_unlock(&list_lock);
}

bool sender_note_errors(int listener) {
    union socket_address address;
    int refused, read = 0;
    for (; read < MOST_ERRORS && read_error(listener, &address, &refused); read++)
        if (refused) note_by_address(&address, refused);
    if (read == MOST_ERRORS) discard_errors(listener);
    return read;
}

/* Like `sender_note_errors`, for errors of the sender's own socket. */
static bool note_own_errors(struct sender *sender) {
    union socket_address address;
    int fd = atomic_load(&sender->fd), refused, read = 0;
    if (fd == atomic_load(&sender->listener)) return sender_note_errors(fd); /* all senders share it */
    for (; read < MOST_ERRORS && read_error(fd, &address, &refused); read++)
        if (refused) note(sender, refused);
    if (read == MOST_ERRORS) discard_errors(fd);
    return read;
}

int sender_take_refused(struct sender *sender) {
    if (!atomic_load_explicit(&sender->refused, memory_order_relaxed)) return 0;
    return atomic_exchange(&sender->refused, 0);
}

/* ---- sending ---- */

/* Send a datagram. Return 0 or an errno. */
static int send_once(struct sender *sender, const void *data, size_t size) {
    int fd = atomic_load_explicit(&sender->fd, memory_order_relaxed);
    uint64_t word = atomic_load_explicit(&sender->to, memory_order_relaxed);
    union socket_address to;
    socklen_t length = word ? unpacked(word, &to) : 0;
    if (!length) return EDESTADDRREQ;
    return sendto(fd, data, size, MSG_DONTWAIT, &to.any, length) < 0 ? errno : 0;
}

/* Send from the port of the socket, and from an address that the kernel chooses. Return 0 or an errno. For IPv6 this is not
 * needed: the kernel does not check the address of the socket. */
static int send_from_any_address(struct sender *sender, const void *data, size_t size) {
    union { struct cmsghdr aligned; char bytes[CMSG_SPACE(sizeof(struct in_pktinfo))]; } control;
    memset(&control, 0, sizeof control); /* no address, no interface */
    control.aligned = (struct cmsghdr){.cmsg_len = CMSG_LEN(sizeof(struct in_pktinfo)), .cmsg_level = IPPROTO_IP,
                                       .cmsg_type = IP_PKTINFO};
    struct iovec from = {(void *)(uintptr_t)data, size};
    union socket_address to;
    struct msghdr message = {.msg_name = &to, .msg_namelen = unpacked(atomic_load(&sender->to), &to), .msg_iov = &from,
                             .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
    return sendmsg(atomic_load(&sender->fd), &message, MSG_DONTWAIT) < 0 ? errno : 0;
}

/* Send through the link instead, if the sender has one: so a datagram through a socket does not pay for links.
 * Retry after an error if it is about an earlier datagram, or if this computer may have lost the socket's address: a brake
 * must then be sent from another one. Return 0 or an errno. */
static __attribute__((noinline)) int send_again(struct sender *sender, const void *data, size_t size, int error) {
    if (sender->link) return link_send(sender->link, data, size, false);
    if (note_own_errors(sender)) error = send_once(sender, data, size);
    bool may_lack_address = (error == EINVAL || error == ENETUNREACH) && atomic_load(&sender->listener) >= 0;
    return may_lack_address ? send_from_any_address(sender, data, size) : error;
}

int sender_send_only(struct sender *sender, const void *data, size_t size) {
    int error = send_once(sender, data, size);
    return error ? send_again(sender, data, size, error) : 0;
}

int sender_send(struct sender *sender, const void *data, size_t size) {
    int error = sender_send_only(sender, data, size);
    return error ? error : sender_take_refused(sender);
}

static void ask_for_room(int fd, int bytes) { setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes); }

/* Send although the socket's send buffer is full. Its contents still count, so commands are refused as before. Return 0 or an
 * errno. */
static int send_beyond_room(struct sender *sender, const void *data, size_t size) {
    int fd = atomic_load(&sender->fd), room;
    socklen_t length = sizeof room;
    if (getsockopt(fd, SOL_SOCKET, SO_SNDBUF, &room, &length)) return errno;
    ask_for_room(fd, INT_MAX / 2); /* the kernel grants net.core.wmem_max */
    int error = send_once(sender, data, size);
    ask_for_room(fd, room / 2); /* the kernel doubles the requested size, and returns the doubled value */
    return error;
}

static void note_errors_of(struct sender *sender) {
    note_own_errors(sender);
    int listener = atomic_load(&sender->listener);
    if (listener >= 0) sender_note_errors(listener);
}

int sender_send_checked(struct sender *sender, const void *data, size_t size) {
    if (sender->link) return link_send(sender->link, data, size, true);
    note_errors_of(sender); /* of earlier datagrams, so that they do not count for this one */
    int error = sender_send(sender, data, size);
    if (error == EAGAIN) error = send_beyond_room(sender, data, size);
    if (error) return error;
    note_errors_of(sender);
    return sender_take_refused(sender);
}
