/* Sends datagrams as a plan says and logs when each was sent.

   --payloads FILE  lines "SOURCE OFFSET HEX": the number of the --from, and where the number of the plan's line is
                    written into the datagram as a little-endian float (exact up to 2^24); 0: nowhere
   --plan FILE      for each datagram 16 bytes: int64 nanoseconds after the start, int64 number of the payload
   --log FILE       for each datagram an int64: CLOCK_REALTIME just before the call that sent it, 0 if that failed
   --first N        what the first line of the plan has for its number

   Runs with a realtime priority where it may, so that nothing gets between the clock and the call. When it is more
   than 2 ms late nevertheless, it moves the rest of the plan instead of catching up, and says so ("slips"): how fast a
   burst that it caused is worked off would be counted as latency of the program under test. Prints one JSON line. */
#define _GNU_SOURCE
#include "../peer/common.h"
#include "realtime.h"
#include <sys/stat.h>

static const char USAGE[] = "send --to A:P --from A:P [--from A:P ...] --payloads FILE --plan FILE --log FILE "
                            "[--first N]";
enum { MAX_PAYLOADS = 1 << 16, MAX_SOURCES = 8, MAX_LATE_NS = 2000000 };

struct payload {
  uint8_t *bytes;
  size_t length, offset;
  unsigned source;
};

struct step {
  int64_t due, payload;
};

static struct payload payloads[MAX_PAYLOADS];

static FILE *opened(const char *path, const char *mode) {
  FILE *file = fopen(path, mode);
  if (file) return file;
  perror(path);
  exit(2);
}

static int64_t read_payloads(const char *path, unsigned sources) {
  char line[2 * MAX_DATAGRAM + 64];
  int64_t count = 0;
  FILE *file = opened(path, "r");
  while (count < MAX_PAYLOADS && fgets(line, sizeof line, file)) {
    struct payload *p = &payloads[count++];
    int begin = 0;
    if (sscanf(line, "%u %zu %n", &p->source, &p->offset, &begin) != 2 || p->source >= sources) exit(2);
    p->bytes = malloc(MAX_DATAGRAM);
    for (const char *hex = line + begin; sscanf(hex, "%2hhx", &p->bytes[p->length]) == 1; hex += 2) p->length++;
  }
  fclose(file);
  return count;
}

static struct step *read_plan(const char *path, size_t *count) {
  struct stat status;
  FILE *file = opened(path, "rb");
  fstat(fileno(file), &status);
  *count = (size_t)status.st_size / sizeof(struct step);
  struct step *plan = calloc(*count + 1, sizeof *plan);
  if (fread(plan, sizeof *plan, *count, file) != *count) exit(2);
  fclose(file);
  return plan;
}

static void sleep_until(int64_t ns) {
  struct timespec t = {ns / 1000000000, ns % 1000000000};
  clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
}

int main(int argc, char **argv) {
  (void)argc;
  check_options(argv, USAGE);
  struct sockaddr_in to = parse_address(option(argv, "--to", 0, ""));
  int sockets[MAX_SOURCES];
  unsigned sources = 0;
  for (const char *from; sources < MAX_SOURCES && (from = option(argv, "--from", (int)sources, NULL)); sources++) {
    sockets[sources] = open_udp(parse_address(from), 0);
    if (connect(sockets[sources], (struct sockaddr *)&to, sizeof to)) { perror("connect"); return 1; }
  }
  const int64_t known = read_payloads(option(argv, "--payloads", 0, ""), sources);
  const int64_t first = atoll(option(argv, "--first", 0, "0"));
  size_t count;
  struct step *plan = read_plan(option(argv, "--plan", 0, ""), &count);
  int64_t *log = calloc(count + 1, sizeof *log);
  for (size_t i = 0; i < count; i++)
    if (plan[i].payload < 0 || plan[i].payload >= known) return 2;
  const int is_realtime = be_realtime();

  int64_t late = 0, errors = 0, slips = 0, start = monotonic_ns() + 1000000;
  for (size_t i = 0; i < count; i++) {
    struct payload *p = &payloads[plan[i].payload];
    const float number = (float)(first + (int64_t)i);
    if (p->offset) memcpy(p->bytes + p->offset, &number, sizeof number);
    const int64_t due = start + plan[i].due;
    if (monotonic_ns() < due) sleep_until(due);
    const int64_t behind = monotonic_ns() - due;
    if (behind > late) late = behind;
    if (behind > MAX_LATE_NS) {
      slips++;
      start += behind;
    }
    const int64_t now = realtime_ns();
    if (send(sockets[p->source], p->bytes, p->length, 0) < 0) errors++;
    else log[i] = now;
  }
  FILE *file = opened(option(argv, "--log", 0, ""), "wb");
  if (fwrite(log, sizeof *log, count, file) != count || fclose(file)) return 1;
  printf("{\"sent\": %ld, \"errors\": %ld, \"slips\": %ld, \"late_max_us\": %.1f, "
         "\"is_realtime\": %d}\n",
         (long)count - errors, errors, slips, (double)late / 1e3, is_realtime);
  return 0;
}
