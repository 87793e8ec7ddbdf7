/* What the kernel lacks for the processes that this is preloaded to: SO_TIMESTAMPNS, and SO_MEMINFO but for a word, as in
 * qemu-user. With NO_STAMPS in the environment it cannot stamp datagrams at all. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <linux/sockios.h>
#include <stdarg.h>
#include <stdlib.h>
#include <sys/socket.h>

int setsockopt(int fd, int level, int option, const void *value, socklen_t size) {
    if (level == SOL_SOCKET && option == SO_TIMESTAMPNS) return errno = ENOPROTOOPT, -1;
    return ((int (*)(int, int, int, const void *, socklen_t))dlsym(RTLD_NEXT, "setsockopt"))(fd, level, option, value, size);
}

int getsockopt(int fd, int level, int option, void *value, socklen_t *size) {
    if (level == SOL_SOCKET && option == SO_MEMINFO && *size > sizeof(int)) *size = sizeof(int);
    return ((int (*)(int, int, int, void *, socklen_t *))dlsym(RTLD_NEXT, "getsockopt"))(fd, level, option, value, size);
}

int ioctl(int fd, unsigned long request, ...) {
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if (request == SIOCGSTAMPNS && getenv("NO_STAMPS")) return errno = ENOTTY, -1;
    return ((int (*)(int, unsigned long, void *))dlsym(RTLD_NEXT, "ioctl"))(fd, request, argument);
}
