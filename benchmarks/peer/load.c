/* Paced UDP load generator.

   Sends the datagrams of a payload file round-robin on an absolute schedule. When it wakes late it
   sends what has become due, at most --burst at once. When it is more than 2 ms late (somebody took
   its core) it moves the schedule instead of catching up, and says so ("slips"): a burst that the
   generator caused would be counted as loss of the program under test.

   Several --to take turns. With --stamp every gps_info datagram carries CLOCK_MONOTONIC nanoseconds in
   utc_timestamp.
   Prints one JSON line. */
#define _GNU_SOURCE
#include "common.h"
#include <sys/mman.h>
#include <sys/prctl.h>

static const char USAGE[] = "load --to A:P [--to A:P ...] [--from A:P] [--rate HZ] [--seconds S] [--burst N] "
                            "[--payloads FILE] [--case NAME] [--stamp]";
enum { MAX_PAYLOADS = 512, MAX_TARGETS = 8, MAX_LATE_NS = 2000000, MAX_STAMP = 1 + 10 };

struct payload {
  uint8_t bytes[MAX_DATAGRAM];
  size_t length;
  size_t stamp_at; /* where utc_timestamp is written; 0: this datagram carries no stamp */
};

/* Cuts utc_timestamp off a gps_info envelope so that stamp() can append a fresh one: a varint has no
   fixed size, and padding it would give the programs under test bytes that no board ever sends. */
static void prepare_stamp(struct payload *p) {
  struct field gps, utc;
  const uint8_t *end = p->bytes + p->length;
  if (!find_field(p->bytes, end, GPS_INFO, &gps)) return;
  const uint8_t *at = find_field(gps.contents, gps.end, UTC_TIMESTAMP, &utc) ? utc.begin : gps.end;
  if (gps.end != end || (at != gps.end && utc.end != gps.end) || at - gps.contents > 127 - MAX_STAMP) {
    fprintf(stderr, "cannot stamp: utc_timestamp has to come last in a short gps_info\n");
    exit(2);
  }
  p->stamp_at = (size_t)(at - p->bytes);
}

static void stamp(struct payload *p) {
  uint8_t *at = p->bytes + p->stamp_at;
  uint64_t now = (uint64_t)monotonic_ns();
  *at++ = UTC_TIMESTAMP << 3; /* the tag of a varint */
  for (; now > 0x7f; now >>= 7) *at++ = (uint8_t)(now | 0x80);
  *at++ = (uint8_t)now;
  p->length = (size_t)(at - p->bytes);
  p->bytes[1] = (uint8_t)(p->length - 2); /* the length of gps_info fits one byte, see prepare_stamp */
}

/* Lines are "[name] hex"; blank lines and lines that begin with '#' are skipped. */
static unsigned read_payloads(const char *path, const char *only, int stamped, struct payload *payloads) {
  char line[2 * MAX_DATAGRAM + 128];
  unsigned count = 0;
  FILE *file = fopen(path, "r");
  while (file && count < MAX_PAYLOADS && fgets(line, sizeof line, file)) {
    const char *name = strtok(line, " \t\r\n"), *hex = strtok(NULL, " \t\r\n");
    if (!name || *name == '#') continue;
    if (!hex) { hex = name; name = ""; }
    if (only && strcmp(only, name)) continue;
    struct payload *p = &payloads[count++];
    for (; p->length < MAX_DATAGRAM && sscanf(hex, "%2hhx", &p->bytes[p->length]) == 1; hex += 2) p->length++;
    if (stamped && !strcmp(name, "gps_info")) prepare_stamp(p);
  }
  if (!count) {
    fprintf(stderr, "no payload to send in %s\n", path);
    exit(2);
  }
  return count;
}

static void sleep_until(int64_t ns) {
  struct timespec t = {ns / 1000000000, ns % 1000000000};
  clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
}

static int open_connected(struct sockaddr_in from, struct sockaddr_in to) {
  int fd = open_udp(from, 0);
  if (connect(fd, (const struct sockaddr *)&to, sizeof to)) { perror("connect"); exit(1); }
  return fd;
}

int main(int argc, char **argv) {
  (void)argc;
  check_options(argv, USAGE);
  const double rate = atof(option(argv, "--rate", 0, "1000")), seconds = atof(option(argv, "--seconds", 0, "5"));
  const int64_t wanted = atoi(option(argv, "--burst", 0, "1")), burst = wanted < BATCH ? wanted : BATCH;
  static struct payload payloads[MAX_PAYLOADS];
  const unsigned count = read_payloads(option(argv, "--payloads", 0, "payloads.txt"),
                                       option(argv, "--case", 0, NULL), flag(argv, "--stamp"), payloads);
  const struct sockaddr_in from = parse_address(option(argv, "--from", 0, "127.0.0.1:0"));
  int sockets[MAX_TARGETS];
  unsigned targets = 0, turn = 0;
  for (const char *to; targets < MAX_TARGETS && (to = option(argv, "--to", (int)targets, NULL)); targets++)
    sockets[targets] = open_connected(from, parse_address(to));
  if (!targets) { fprintf(stderr, "usage: %s\n", USAGE); return 2; }
  struct iovec parts[BATCH];
  struct mmsghdr batch[BATCH] = {0};
  for (int i = 0; i < BATCH; i++) batch[i].msg_hdr = (struct msghdr){.msg_iov = &parts[i], .msg_iovlen = 1};
  prctl(PR_SET_TIMERSLACK, 1UL, 0, 0, 0);
  mlockall(MCL_CURRENT | MCL_FUTURE);

  uint64_t sent = 0, errors = 0, slips = 0, next = 0;
  int64_t scheduled = 0, slipped_ns = 0, max_late_ns = 0, since = monotonic_ns() + 1000000;
  const int64_t start = since, end = start + (int64_t)(seconds * 1e9);
  for (;;) {
    int64_t due = since + (int64_t)((double)scheduled * 1e9 / rate), now = monotonic_ns();
    if (due >= end || now >= end) break;
    if (now < due) { sleep_until(due); now = monotonic_ns(); }
    int64_t late = now - due;
    if (late > max_late_ns) max_late_ns = late;
    if (late > MAX_LATE_NS) {
      slips++;
      slipped_ns += late;
      since = now;
      scheduled = 0;
    }
    int64_t ready = (int64_t)((double)(now - since) * rate / 1e9) + 1 - scheduled;
    unsigned n = (unsigned)(ready > burst ? burst : ready > 1 ? ready : 1);
    for (unsigned i = 0; i < n; i++) {
      struct payload *p = &payloads[(next + i) % count];
      if (p->stamp_at) stamp(p);
      parts[i] = (struct iovec){p->bytes, p->length};
    }
    int done = sendmmsg(sockets[turn++ % targets], batch, n, 0);
    if (done > 0) sent += (unsigned)done;
    else { errors++; done = 1; } /* refused: nobody listens; go on */
    scheduled += done;
    next += (unsigned)done;
  }
  double elapsed = (double)(monotonic_ns() - start) / 1e9;
  printf("{\"sent\": %lu, \"errors\": %lu, \"seconds\": %.4f, \"rate\": %.1f, \"slips\": %lu, "
         "\"slipped_ms\": %.2f, \"max_late_us\": %.1f}\n",
         sent, errors, elapsed, (double)sent / elapsed, slips, (double)slipped_ns / 1e6, (double)max_late_ns / 1e3);
  return 0;
}
