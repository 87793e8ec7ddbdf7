/* Threads make addresses known, receive from more of them than are kept, and send, all at once. Of addresses with one number
 * that of a table has it. The argument is how many addresses each thread takes. */
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "hosts.h"

enum { THREADS = 3, CANDIDATES = 200000, PAIRS = 32, KNOWN = 2 * PAIRS, POOL = 8192 };

static struct sockaddr_in6 pool[POOL]; /* the first KNOWN come as pairs with one number; of each, the first is a table's */
static long count;

static struct sockaddr_in6 address(uint32_t index) {
    struct sockaddr_in6 made = {.sin6_family = AF_INET6};
    memcpy(made.sin6_addr.s6_addr, "\x20\x01\x0d\xb8", 4);
    uint64_t spread = index * 0x9e3779b97f4a7c15u;
    memcpy(made.sin6_addr.s6_addr + 8, &spread, sizeof spread);
    return made;
}

/* As in router/hosts.py. */
static uint32_t number_of(const struct sockaddr_in6 *of) {
    uint32_t hash = 2166136261u;
    for (int index = 0; index < HOST_BYTES; index++) hash = (hash ^ of->sin6_addr.s6_addr[index]) * 16777619u;
    return FIRST_IPV6 + hash % (LAST_IPV6 - FIRST_IPV6 + 1);
}

struct candidate {
    uint32_t number, index;
};

static int by_number(const void *one, const void *other) {
    const struct candidate *a = one, *b = other;
    return a->number < b->number ? -1 : a->number > b->number;
}

static void fill_pool(void) {
    static struct candidate candidates[CANDIDATES];
    for (uint32_t index = 0; index < CANDIDATES; index++) {
        struct sockaddr_in6 made = address(index);
        candidates[index] = (struct candidate){number_of(&made), index};
    }
    qsort(candidates, CANDIDATES, sizeof *candidates, by_number);
    uint32_t paired = 0, single = KNOWN;
    for (uint32_t at = 0; at + 1 < CANDIDATES; at++) {
        bool is_pair = candidates[at].number == candidates[at + 1].number;
        if (!is_pair && single < POOL) pool[single++] = address(candidates[at].index);
        if (!is_pair || paired == KNOWN) {
            at += is_pair;
            continue;
        }
        pool[paired++] = address(candidates[at].index);
        pool[paired++] = address(candidates[++at].index);
    }
    check(paired == KNOWN && single == POOL, "there are pairs");
}

static bool is_known(uint32_t index) { return index < KNOWN && index % 2 == 0; }

static bool is_learned(uint32_t index) { return index >= KNOWN && index % 64 == 0; }

static void *add(void *unused) {
    for (long turn = 0; turn < count; turn++) {
        uint32_t index = (uint32_t)turn * 2 % KNOWN;
        check(host_add(pool[index].sin6_addr.s6_addr, 0), "there is room for an address of a table");
        check(!host_add(pool[index + 1].sin6_addr.s6_addr, 0), "its number is not given to another one");
        check(host_number_ipv6(&pool[index]) == number_of(&pool[index]), "an address of a table has its number");
        check(host_number_ipv6(&pool[index + 1]) == HOST_UNKNOWN, "another one does not");
    }
    return unused;
}

static void *receive(void *seed) {
    unsigned random = (unsigned)(uintptr_t)seed;
    for (long turn = 0; turn < count; turn++) {
        uint32_t index = (uint32_t)rand_r(&random) % POOL, number = host_number_ipv6(&pool[index]);
        check(number == HOST_UNKNOWN || number == number_of(&pool[index]), "a sender has its own number");
        union socket_address to;
        if (number == HOST_UNKNOWN || index < KNOWN) continue;
        bool is_kept = is_learned(index) && host_keep(number);
        socklen_t size = host_address(number, 1, &to);
        check(size || !is_kept, "an address that is kept stays");
        if (size) check(!memcmp(&to.v6.sin6_addr, &pool[index].sin6_addr, HOST_BYTES), "it is that of the sender");
    }
    return NULL;
}

static void *look_up(void *seed) {
    unsigned random = (unsigned)(uintptr_t)seed;
    char text[HOST_TEXT];
    uint8_t bytes[HOST_BYTES];
    for (long turn = 0; turn < count; turn++) {
        uint32_t index = (uint32_t)rand_r(&random) % POOL, number = number_of(&pool[index]);
        if (!host_bytes(number, bytes)) continue;
        bool is_it = !memcmp(bytes, &pool[index].sin6_addr, HOST_BYTES);
        check(is_it || index < KNOWN, "a number has one address");
        host_text(number, text);
    }
    return NULL;
}

int main(int arguments, char **values) {
    check(arguments == 2, "one argument");
    count = atol(values[1]);
    fill_pool();
    void *(*const works[])(void *) = {add, receive, look_up};
    pthread_t threads[3 * THREADS];
    for (uintptr_t index = 0; index < 3 * THREADS; index++)
        check(!pthread_create(&threads[index], NULL, works[index % 3], (void *)index), "a thread starts");
    for (int index = 0; index < 3 * THREADS; index++) pthread_join(threads[index], NULL);
    for (uint32_t index = 0; index < POOL; index++) {
        uint32_t number = host_number_ipv6(&pool[index]);
        check(number == (index < KNOWN && !is_known(index) ? HOST_UNKNOWN : number_of(&pool[index])),
              "only an address with the number of a table's has none");
    }
    return 0;
}
