#include "sender.h"

#include <errno.h>
#include <linux/errqueue.h>
#include <netinet/ip_icmp.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

enum { MOST_ERRORS = 32 }; /* that are read at once */

static pthread_mutex_t list_lock = PTHREAD_MUTEX_INITIALIZER; /* held for some steps only */
static struct sender *first;

struct sender *sender_open(int fd, int errors, uint32_t address, uint16_t port) {
    struct sender *sender = calloc(1, sizeof *sender);
    if (!sender) return NULL;
    sender->address = (struct sockaddr_in){
        .sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(address)};
    sender_move(sender, fd, errors);
    pthread_mutex_lock(&list_lock);
    sender->next = first;
    first = sender;
    pthread_mutex_unlock(&list_lock);
    return sender;
}

void sender_move(struct sender *sender, int fd, int errors) {
    atomic_store(&sender->fd, fd);
    atomic_store(&sender->errors, errors);
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

/* Whether the receiver has refused a datagram. Routers report passing troubles too, and this computer reports that nobody
 * answers ARP: those say nothing about the next datagram. */
static bool is_refusal(const struct sock_extended_err *error) {
    if (error->ee_origin != SO_EE_ORIGIN_ICMP || error->ee_type != ICMP_DEST_UNREACH) return false;
    return error->ee_code != ICMP_NET_UNREACH && error->ee_code != ICMP_HOST_UNREACH;
}

/* Of several senders to one address, the first that has no error yet is told. */
static void note(int errors, const struct sockaddr_in *address, int error) {
    pthread_mutex_lock(&list_lock);
    for (struct sender *each = first; each; each = each->next) {
        int none = 0;
        if (atomic_load(&each->errors) == errors && each->address.sin_port == address->sin_port &&
            each->address.sin_addr.s_addr == address->sin_addr.s_addr &&
            atomic_compare_exchange_strong(&each->refused, &none, error))
            break;
    }
    pthread_mutex_unlock(&list_lock);
}

/* Read one error. Return whether there was one. */
static bool note_next(int errors) {
    struct sockaddr_in address; /* that the datagram was sent to */
    union { struct cmsghdr aligned; char bytes[256]; } control;
    struct msghdr message = {.msg_name = &address, .msg_namelen = sizeof address, .msg_control = &control,
                             .msg_controllen = sizeof control};
    if (recvmsg(errors, &message, MSG_ERRQUEUE | MSG_DONTWAIT) < 0) return false;
    for (struct cmsghdr *each = CMSG_FIRSTHDR(&message); each; each = CMSG_NXTHDR(&message, each)) {
        if (each->cmsg_level != IPPROTO_IP || each->cmsg_type != IP_RECVERR) continue;
        struct sock_extended_err error;
        memcpy(&error, CMSG_DATA(each), sizeof error);
        if (is_refusal(&error)) note(errors, &address, (int)error.ee_errno);
    }
    return true;
}

/* Errors share the memory of the receive buffer: what a flood has left there would keep datagrams out. */
static void discard_errors(int errors) {
    for (int wanted = 0; wanted <= 1; wanted++) setsockopt(errors, IPPROTO_IP, IP_RECVERR, &wanted, sizeof wanted);
}

bool sender_note_errors(int errors) {
    int read = 0;
    while (read < MOST_ERRORS && note_next(errors)) read++;
    if (read == MOST_ERRORS) discard_errors(errors);
    return read;
}

static int take_refused(struct sender *sender) {
    if (!atomic_load_explicit(&sender->refused, memory_order_relaxed)) return 0;
    return atomic_exchange(&sender->refused, 0);
}

/* ---- sending ---- */

/* Return 0 or an errno. */
static int send_once(struct sender *sender, const void *data, size_t size) {
    int fd = atomic_load_explicit(&sender->fd, memory_order_relaxed);
    const struct sockaddr *to = (const struct sockaddr *)&sender->address;
    return sendto(fd, data, size, MSG_DONTWAIT, to, sizeof sender->address) < 0 ? errno : 0;
}

/* Send from the port that the socket is bound to, and from whichever address the kernel chooses. Return 0 or an errno. */
static int send_from_any_address(struct sender *sender, const void *data, size_t size) {
    union { struct cmsghdr aligned; char bytes[CMSG_SPACE(sizeof(struct in_pktinfo))]; } control;
    memset(&control, 0, sizeof control); /* no address, no interface */
    control.aligned = (struct cmsghdr){.cmsg_len = CMSG_LEN(sizeof(struct in_pktinfo)), .cmsg_level = IPPROTO_IP,
                                       .cmsg_type = IP_PKTINFO};
    struct iovec from = {(void *)(uintptr_t)data, size};
    struct msghdr message = {.msg_name = &sender->address, .msg_namelen = sizeof sender->address, .msg_iov = &from,
                             .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
    return sendmsg(atomic_load(&sender->fd), &message, MSG_DONTWAIT) < 0 ? errno : 0;
}

/* Try again after an error, if it may be of an earlier datagram, or if this computer may have lost the address that the
 * socket is bound to: a brake has to leave from another one. Return 0 or an errno. */
static int send_again(struct sender *sender, const void *data, size_t size, int error) {
    int errors = atomic_load(&sender->errors);
    if (errors == atomic_load(&sender->fd)) return sender_note_errors(errors) ? send_once(sender, data, size) : error;
    if (error == EINVAL || error == ENETUNREACH) return send_from_any_address(sender, data, size);
    return error;
}

int sender_send(struct sender *sender, const void *data, size_t size) {
    int error = send_once(sender, data, size);
    if (error) error = send_again(sender, data, size, error);
    return error ? error : take_refused(sender);
}

int sender_send_checked(struct sender *sender, const void *data, size_t size) {
    sender_note_errors(atomic_load(&sender->errors)); /* of earlier datagrams: they are not taken for this one's */
    int error = sender_send(sender, data, size);
    if (error) return error;
    sender_note_errors(atomic_load(&sender->errors));
    return take_refused(sender);
}
