#include "hosts.h"

#include <arpa/inet.h>
#include <net/if.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>

enum { SLOTS = 2 * MOST_HOSTS };

struct host {
    _Atomic uint32_t number; /* 0 for none; written last */
    _Atomic uint32_t interface;
    uint8_t address[HOST_BYTES];
};

/* Addresses by number, with open addressing. */
struct hosts {
    struct host slots[SLOTS];
    uint32_t count; /* under the lock */
};

static struct hosts known, kept; /* of tables, and of learned endpoints: they stay */
static struct hosts seen;        /* of other senders; under the lock */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER; /* to add; held only briefly */

/* FNV-1a */
static uint32_t hashed(uint32_t hash, const void *bytes, size_t size) {
    for (size_t index = 0; index < size; index++) hash = (hash ^ ((const uint8_t *)bytes)[index]) * 16777619u;
    return hash;
}

static uint32_t number_of(const uint8_t *address, uint32_t interface) {
    uint32_t hash = hashed(2166136261u, address, HOST_BYTES);
    if (interface) hash = hashed(hash, &interface, sizeof interface);
    return FIRST_IPV6 + hash % (LAST_IPV6 - FIRST_IPV6 + 1);
}

/* The slot of a number, or the free one where it belongs. At most half of the slots are taken. */
static struct host *slot(struct hosts *hosts, uint32_t number) {
    uint32_t at = number % SLOTS;
    for (;; at = (at + 1) % SLOTS) {
        uint32_t found = atomic_load_explicit(&hosts->slots[at].number, memory_order_acquire);
        if (!found || found == number) return &hosts->slots[at];
    }
}

static struct host *find(struct hosts *hosts, uint32_t number) {
    struct host *found = slot(hosts, number);
    return atomic_load_explicit(&found->number, memory_order_acquire) ? found : NULL;
}

static struct host *find_lasting(uint32_t number) {
    struct host *found = find(&known, number);
    return found ? found : find(&kept, number);
}

static bool is_at(const struct host *host, const uint8_t *address) { return !memcmp(host->address, address, HOST_BYTES); }

/* Add an address that is not there, if there is room. The caller holds the lock. */
static void add(struct hosts *hosts, uint32_t number, const uint8_t *address, uint32_t interface) {
    struct host *free = slot(hosts, number);
    if (hosts->count >= MOST_HOSTS || atomic_load(&free->number)) return;
    hosts->count++;
    memcpy(free->address, address, HOST_BYTES);
    atomic_store(&free->interface, interface);
    atomic_store_explicit(&free->number, number, memory_order_release);
}

bool host_add(const uint8_t *address, uint32_t interface) {
    uint32_t number = number_of(address, 0);
    pthread_mutex_lock(&lock);
    add(&known, number, address, interface);
    struct host *found = find(&known, number);
    bool is_known = found && is_at(found, address);
    if (is_known) atomic_store(&found->interface, interface);
    pthread_mutex_unlock(&lock);
    return is_known;
}

static bool is_same(const struct host *host, const uint8_t *address, uint32_t interface) {
    return is_at(host, address) && atomic_load(&host->interface) == interface;
}

/* Return the number of a sender that does not last. */
static uint32_t see(uint32_t number, const uint8_t *address, uint32_t interface) {
    pthread_mutex_lock(&lock);
    if (seen.count == MOST_HOSTS && !find(&seen, number)) memset(&seen, 0, sizeof seen);
    add(&seen, number, address, interface);
    bool is_seen = is_same(find(&seen, number), address, interface);
    pthread_mutex_unlock(&lock);
    return is_seen ? number : HOST_UNKNOWN;
}

/* Return the number of a sender: that of a table's address only if it has the same interface. */
static uint32_t number_of_sender(const uint8_t *address, uint32_t interface) {
    uint32_t number = number_of(address, 0);
    const struct host *found = find(&known, number);
    if (!found) {
        number = number_of(address, interface);
        found = find_lasting(number);
    }
    if (!found) return see(number, address, interface);
    return is_same(found, address, interface) ? number : HOST_UNKNOWN;
}

uint32_t host_number_ipv6(const struct sockaddr_in6 *address) {
    const uint8_t *bytes = address->sin6_addr.s6_addr;
    if (!IN6_IS_ADDR_V4MAPPED(&address->sin6_addr)) return number_of_sender(bytes, address->sin6_scope_id);
    uint32_t number;
    memcpy(&number, bytes + 12, sizeof number);
    return ntohl(number);
}

bool host_keep(uint32_t number) {
    if (!host_is_ipv6(number)) return true;
    pthread_mutex_lock(&lock);
    const struct host *sender = find_lasting(number) ? NULL : find(&seen, number);
    if (sender) add(&kept, number, sender->address, sender->interface);
    bool is_kept = find_lasting(number);
    pthread_mutex_unlock(&lock);
    return is_kept;
}

static socklen_t write_address(const struct host *host, uint16_t port, struct sockaddr_in6 *to) {
    if (!host) return 0;
    *to = (struct sockaddr_in6){
        .sin6_family = AF_INET6, .sin6_port = htons(port), .sin6_scope_id = atomic_load(&host->interface)};
    memcpy(&to->sin6_addr, host->address, HOST_BYTES);
    return sizeof *to;
}

socklen_t host_address(uint32_t number, uint16_t port, union socket_address *to) {
    if (!host_is_ipv6(number)) {
        to->v4 = (struct sockaddr_in){
            .sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(number)};
        return sizeof to->v4;
    }
    socklen_t size = write_address(find_lasting(number), port, &to->v6);
    if (size) return size;
    pthread_mutex_lock(&lock);
    size = write_address(find(&seen, number), port, &to->v6);
    pthread_mutex_unlock(&lock);
    return size;
}

bool host_bytes(uint32_t number, uint8_t *to) {
    static const uint8_t mapped[] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff};
    union socket_address address;
    if (!host_address(number, 0, &address)) return false;
    if (address.any.sa_family == AF_INET6) {
        memcpy(to, &address.v6.sin6_addr, HOST_BYTES);
        return true;
    }
    memcpy(to, mapped, sizeof mapped);
    memcpy(to + sizeof mapped, &address.v4.sin_addr, HOST_BYTES - sizeof mapped);
    return true;
}

void host_text(uint32_t number, char *to) {
    union socket_address address;
    char interface[IF_NAMESIZE];
    if (!host_address(number, 0, &address)) address.v6 = (struct sockaddr_in6){.sin6_family = AF_INET6};
    bool is_v6 = address.any.sa_family == AF_INET6;
    inet_ntop(address.any.sa_family, is_v6 ? (void *)&address.v6.sin6_addr : &address.v4.sin_addr, to, HOST_TEXT);
    if (is_v6 && address.v6.sin6_scope_id && if_indextoname(address.v6.sin6_scope_id, interface))
        snprintf(to + strlen(to), HOST_TEXT - strlen(to), "%%%s", interface);
}
