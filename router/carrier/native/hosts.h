/* IP addresses as numbers, so that everything else has one kind of address. Thread-safe.
 *
 * An IPv4 address is its own number, in host byte order. The number of an IPv6 address is a hash of it, from FIRST_IPV6 to
 * LAST_IPV6, which no IPv4 host has: it is the same in every process, except that of a link-local sender that no table has,
 * which depends on the network interface. A process knows the addresses of its tables, those that it is to keep, and others
 * that it has received from: when these are MOST_HOSTS, it forgets them. An address whose number is that of another one is
 * HOST_UNKNOWN: no sender can pass for another that is known. */
#ifndef HOSTS_H
#define HOSTS_H

#include <netinet/in.h>
#include <stdbool.h>
#include <stdint.h>
#include <sys/socket.h>

#define HOST_UNKNOWN 0xf0000000u
#define FIRST_IPV6 0xf0000001u
#define LAST_IPV6 0xfffffffeu

enum { MOST_HOSTS = 4096, HOST_BYTES = 16, HOST_TEXT = 64 /* bytes, with the NUL */ };

union socket_address {
    struct sockaddr any;
    struct sockaddr_in v4;
    struct sockaddr_in6 v6;
};

static inline bool host_is_ipv6(uint32_t number) { return number >= HOST_UNKNOWN && number <= LAST_IPV6; }

/* Know the IPv6 address (HOST_BYTES) of a table from now on, with the index of the network interface of a link-local one, or
 * 0. Return false if another address of a table has its number, or there are too many. */
bool host_add(const uint8_t *address, uint32_t interface);

/* The number of a sender's address. */
uint32_t host_number_ipv6(const struct sockaddr_in6 *address);
static inline uint32_t host_number(const union socket_address *address) {
    return address->any.sa_family == AF_INET ? ntohl(address->v4.sin_addr.s_addr) : host_number_ipv6(&address->v6);
}

static inline uint16_t host_port(const union socket_address *address) {
    return ntohs(address->v4.sin_port); /* at the same place in both */
}

/* Keep the address of a sender, of which an endpoint is learned. Return false if it is not known, or there are too many. */
bool host_keep(uint32_t number);

/* Write the socket address of a number and a port. Return its size, or 0 for an IPv6 address that is not known. */
socklen_t host_address(uint32_t number, uint16_t port, union socket_address *to);

/* Write an address as HOST_BYTES of IPv6, an IPv4 one as mapped. Return false for an IPv6 address that is not known. */
bool host_bytes(uint32_t number, uint8_t *to);

/* Write an address as text: HOST_TEXT bytes. One that is not known is "::", which no host has. */
void host_text(uint32_t number, char *to);

#endif
