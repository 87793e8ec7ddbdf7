/* Drains UDP ports, counts, and measures one-way latency from the stamps that datagrams carry:
   CLOCK_MONOTONIC in gps_info.utc_timestamp (put there by load --stamp).

   By default it wakes for every datagram, as a real receiver would; latency ends when this program has
   the datagram. With --poll-us N it looks only every N microseconds, so that the sender never pays for
   waking it: on a real network the receiver is another machine. Use that for CPU and rate, not latency.

   On SIGUSR1 it prints a JSON line: how much came to the first port so far, and when that was.
   On SIGTERM it prints one with everything, and ends. */
#define _GNU_SOURCE
#include "common.h"
#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>

static const char USAGE[] = "sink --listen A:P [--listen A:P ...] [--poll-us N]";
enum { MAX_PORTS = 8, MAX_SAMPLES = 1 << 20, SINK_BUFFER = 32 << 20, MEMINFO_DROPS = 8 };

struct port {
  const char *name;
  int fd;
  uint64_t datagrams, bytes;
  int64_t *latency_ns;
  uint32_t samples;
};

static volatile sig_atomic_t stopping, asked;

static void stop(int number) { stopping = number; }
static void ask(int number) { asked = number; }

/* Latency of one datagram in ns, or -1 when it carries no stamp. */
static int64_t latency(const uint8_t *datagram, size_t length, int64_t now) {
  struct field gps, utc;
  if (!find_field(datagram, datagram + length, GPS_INFO, &gps)) return -1;
  return find_field(gps.contents, gps.end, UTC_TIMESTAMP, &utc) ? now - (int64_t)utc.varint : -1;
}

static void drain(struct port *port) {
  static uint8_t bytes[BATCH][MAX_DATAGRAM];
  static struct iovec parts[BATCH];
  static struct mmsghdr batch[BATCH];
  int received;
  for (int i = 0; i < BATCH; i++) {
    parts[i] = (struct iovec){bytes[i], MAX_DATAGRAM};
    batch[i].msg_hdr = (struct msghdr){.msg_iov = &parts[i], .msg_iovlen = 1};
  }
  do {
    received = recvmmsg(port->fd, batch, BATCH, MSG_DONTWAIT, NULL);
    int64_t now = monotonic_ns();
    for (int i = 0; i < received; i++) {
      int64_t ns = latency(bytes[i], batch[i].msg_len, now);
      if (ns >= 0 && port->samples < MAX_SAMPLES) port->latency_ns[port->samples++] = ns;
      port->bytes += batch[i].msg_len;
      port->datagrams++;
    }
  } while (received == BATCH);
}

static int ascending(const void *a, const void *b) {
  int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
  return (x > y) - (x < y);
}

static void print_port(const struct port *p) {
  uint32_t memory[9] = {0}; /* SO_MEMINFO: word 8 counts what this socket dropped */
  socklen_t size = sizeof memory;
  getsockopt(p->fd, SOL_SOCKET, SO_MEMINFO, memory, &size);
  printf("{\"address\": \"%s\", \"datagrams\": %lu, \"bytes\": %lu, \"drops\": %u, \"latency_us\": ",
         p->name, p->datagrams, p->bytes, memory[MEMINFO_DROPS]);
  if (!p->samples) {
    printf("null}");
    return;
  }
  qsort(p->latency_ns, p->samples, sizeof *p->latency_ns, ascending);
#define QUANTILE(q) ((double)p->latency_ns[(uint32_t)((p->samples - 1) * (q) + 0.5)] / 1e3)
  printf("{\"n\": %u, \"p50\": %.1f, \"p99\": %.1f, \"p999\": %.1f, \"max\": %.1f}}", p->samples,
         QUANTILE(.5), QUANTILE(.99), QUANTILE(.999), QUANTILE(1));
}

int main(int argc, char **argv) {
  struct port ports[MAX_PORTS] = {0};
  struct pollfd waiting[MAX_PORTS];
  int count = 0;
  (void)argc;
  check_options(argv, USAGE);
  const long poll_us = atol(option(argv, "--poll-us", 0, "0"));
  for (const char *name; count < MAX_PORTS && (name = option(argv, "--listen", count, NULL)); count++) {
    int fd = open_udp(parse_address(name), SINK_BUFFER);
    ports[count] = (struct port){.name = name, .fd = fd, .latency_ns = calloc(MAX_SAMPLES, sizeof(int64_t))};
    waiting[count] = (struct pollfd){.fd = fd, .events = POLLIN};
  }
  sigaction(SIGTERM, &(struct sigaction){.sa_handler = stop}, NULL);
  sigaction(SIGUSR1, &(struct sigaction){.sa_handler = ask}, NULL);
  prctl(PR_SET_TIMERSLACK, 1UL, 0, 0, 0);
  while (!stopping) {
    if (poll_us) nanosleep(&(struct timespec){0, poll_us * 1000}, NULL);
    else poll(waiting, (nfds_t)count, 200);
    for (int i = 0; i < count; i++) drain(&ports[i]);
    if (asked) {
      asked = 0;
      printf("{\"datagrams\": %lu, \"at_ns\": %ld}\n", ports[0].datagrams, monotonic_ns());
      fflush(stdout);
    }
  }
  printf("{\"ports\": [");
  for (int i = 0; i < count; i++) {
    if (i) printf(", ");
    print_port(&ports[i]);
  }
  printf("]}\n");
  return 0;
}
