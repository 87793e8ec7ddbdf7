/* A library to preload: the start of thread number FAILING_THREAD fails, as it does at a limit of threads. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>

typedef void *(*routine)(void *);

int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, routine start, void *argument) {
    static atomic_int started;
    int (*create)(pthread_t *, const pthread_attr_t *, routine, void *);
    *(void **)&create = dlsym(RTLD_NEXT, "pthread_create");
    if (++started == atoi(getenv("FAILING_THREAD"))) return EAGAIN;
    return create(thread, attributes, start, argument);
}
