/* What the receive thread does when the kernel fails to hand over a datagram: attempts, pauses and outcomes. */
#include "carrier.c"

#include <arpa/inet.h>
#include <sys/syscall.h>

#include "check.h"

static int failures, failure, calls, pauses; /* the next `failures` calls fail with the errno `failure` */

ssize_t recvmsg(int fd, struct msghdr *message, int flags) {
    if (!(flags & MSG_ERRQUEUE)) {
        calls++;
        if (failures > 0) {
            failures--;
            errno = failure;
            return -1;
        }
    }
    return syscall(SYS_recvmsg, fd, message, flags);
}

int usleep(useconds_t duration) {
    (void)duration;
    pauses++;
    errno = EINTR;
    return -1;
}

static void fail(int times, int error) { failures = times, failure = error, calls = pauses = 0; }

static ssize_t received(int fd) {
    char data[16];
    struct iovec into = {data, sizeof data};
    struct msghdr message = {.msg_iov = &into, .msg_iovlen = 1};
    return receive(fd, &message, MSG_DONTWAIT);
}

int main(void) {
    static struct carrier carrier;
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    int fd = socket(AF_INET, SOCK_DGRAM, 0);
    bind(fd, (struct sockaddr *)&address, size);
    getsockname(fd, (struct sockaddr *)&address, &size);
    struct listener listener = {.fd = fd};

    sendto(fd, "abc", 3, 0, (struct sockaddr *)&address, size);
    fail(2, ENOMEM);
    check(received(fd) == 3, "a datagram after two failures");
    check(calls == 3, "its attempts");
    check(pauses == 0, "its pauses");

    fail(1000, ENOMEM);
    check(receive_one(&carrier, &listener, MSG_DONTWAIT) == RECEIVE_FAILED, "lasting failure");
    check(calls == 4, "its attempts");
    check(pauses == 1, "its pauses");

    fail(1, ECONNREFUSED);
    check(receive_one(&carrier, &listener, MSG_DONTWAIT) == FOUND_EMPTY, "a failure, then an empty queue");
    check(calls == 2, "its attempts");
    check(pauses == 0, "its pauses");

    fail(0, 0);
    check(receive_one(&carrier, &listener, MSG_DONTWAIT) == FOUND_EMPTY, "an empty queue");
    check(calls == 1, "its attempts");

    close(fd);
    fail(0, 0);
    check(receive_one(&carrier, &listener, MSG_DONTWAIT) == RECEIVE_FAILED, "a closed socket");
    check(pauses == 1, "its pauses");
    return 0;
}
