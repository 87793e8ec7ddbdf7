/* Receives datagrams and logs when the kernel got each: its own turn on a processor does not count.

   --listen A:P  up to eight times; --log FILE gets for each datagram a `struct arrival`, in no order among ports

   Looks every millisecond, so that it costs the sender no wake-ups, as if it were another machine. Prints a JSON line
   when it listens, and on SIGTERM, when the log is written, another. */
#define _GNU_SOURCE
#include "../peer/common.h"
#include "realtime.h"
#include <signal.h>

static const char USAGE[] = "receive --listen A:P [--listen A:P ...] --log FILE";
enum { MAX_PORTS = 8, HEAD = 48, BUFFER = 32 << 20, MEMINFO_DROPS = 8, MAX_ARRIVALS = 1 << 21 };

struct arrival {
  int64_t at; /* CLOCK_REALTIME, ns */
  uint32_t port, length;
  uint8_t head[HEAD]; /* how the datagram begins */
};

static volatile sig_atomic_t stopping;
static struct arrival *arrivals;
static size_t count;

static void stop(int number) { stopping = number; }

static int64_t stamp_of(struct msghdr *message) {
  for (struct cmsghdr *c = CMSG_FIRSTHDR(message); c; c = CMSG_NXTHDR(message, c)) {
    struct timespec at;
    if (c->cmsg_level != SOL_SOCKET || c->cmsg_type != SCM_TIMESTAMPNS) continue;
    memcpy(&at, CMSG_DATA(c), sizeof at);
    return at.tv_sec * 1000000000LL + at.tv_nsec;
  }
  return realtime_ns();
}

static void drain(int fd, uint32_t port) {
  static uint8_t bytes[BATCH][MAX_DATAGRAM], controls[BATCH][128];
  static struct iovec parts[BATCH];
  static struct mmsghdr batch[BATCH];
  int received;
  do {
    for (int i = 0; i < BATCH; i++) {
      parts[i] = (struct iovec){bytes[i], MAX_DATAGRAM};
      batch[i].msg_hdr = (struct msghdr){
        .msg_iov = &parts[i], .msg_iovlen = 1, .msg_control = controls[i], .msg_controllen = sizeof controls[i]};
    }
    received = recvmmsg(fd, batch, BATCH, MSG_DONTWAIT, NULL);
    for (int i = 0; i < received && count < MAX_ARRIVALS; i++) {
      struct arrival *a = &arrivals[count++];
      *a = (struct arrival){.at = stamp_of(&batch[i].msg_hdr), .port = port, .length = batch[i].msg_len};
      memcpy(a->head, bytes[i], a->length < HEAD ? a->length : HEAD);
    }
  } while (received == BATCH);
}

static unsigned long drops_of(int fd) {
  uint32_t memory[9] = {0}; /* SO_MEMINFO: word 8 counts what this socket dropped */
  socklen_t size = sizeof memory;
  getsockopt(fd, SOL_SOCKET, SO_MEMINFO, memory, &size);
  return memory[MEMINFO_DROPS];
}

int main(int argc, char **argv) {
  (void)argc;
  check_options(argv, USAGE);
  int sockets[MAX_PORTS], on = 1;
  uint32_t ports = 0;
  for (const char *name; ports < MAX_PORTS && (name = option(argv, "--listen", (int)ports, NULL)); ports++) {
    sockets[ports] = open_udp(parse_address(name), BUFFER);
    setsockopt(sockets[ports], SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
  }
  arrivals = calloc(MAX_ARRIVALS, sizeof *arrivals);
  sigaction(SIGTERM, &(struct sigaction){.sa_handler = stop}, NULL);
  const int is_realtime = be_realtime();
  printf("{\"ports\": %u, \"is_realtime\": %d}\n", ports, is_realtime);
  fflush(stdout);
  while (!stopping) {
    nanosleep(&(struct timespec){0, 1000000}, NULL);
    for (uint32_t i = 0; i < ports; i++) drain(sockets[i], i);
  }
  unsigned long drops = 0;
  for (uint32_t i = 0; i < ports; i++) drops += drops_of(sockets[i]);
  FILE *file = fopen(option(argv, "--log", 0, ""), "wb");
  if (!file || fwrite(arrivals, sizeof *arrivals, count, file) != count || fclose(file)) return 1;
  printf("{\"received\": %zu, \"drops\": %lu}\n", count, drops);
  return 0;
}
