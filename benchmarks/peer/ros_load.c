/* Publishes to many ROS topics at a steady rate, each message with the time at which it is published.
 *
 * One line of --topics FILE for each: NAME TYPE QOS HZ STAMP OFFSET HEX. HEX is the serialized message. At byte OFFSET
 * of it the wall clock is written: `time` as a builtin_interfaces/Time, `float` as a double of seconds, `characters` as
 * 17 of them, of seconds. QOS is reliable, best_effort or transient_local; depth 10.
 *
 * Prints {"ready": true} when all publishers are there, publishes until SIGTERM, and then prints how many messages it
 * published and by how much the latest of them was late. */
#include <dlfcn.h>
#include <errno.h>
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <signal.h>

#include "common.h"

/* The wheels' librcl.so needs libraries that are meant for Python extensions. Their functions are bound when called,
 * hence never; but the loader insists on these two objects of libpython (exported by -rdynamic). */
void *PyExc_RuntimeError = NULL;
void *_Py_TrueStruct[4];

enum { MOST_TOPICS = 1024, NS = 1000000000 };

struct topic {
  rcl_publisher_t publisher;
  rcl_serialized_message_t message;
  char stamp; /* first letter of its kind */
  size_t offset;
  int64_t period, due; /* ns; monotonic */
};

static struct topic topics[MOST_TOPICS];
static int count;
static volatile sig_atomic_t stopping;

static void stop(int number) {
  (void)number;
  stopping = 1;
}

static void check(rcl_ret_t result, const char *what) {
  if (result == RCL_RET_OK) return;
  fprintf(stderr, "%s: %s\n", what, rcl_get_error_string().str);
  exit(1);
}

/* "std_msgs/msg/String" -> its type support, from the package's library. */
static const rosidl_message_type_support_t *type_support(const char *type) {
  char package[64], name[64], library[128], symbol[256];
  if (sscanf(type, "%63[^/]/msg/%63s", package, name) != 2) exit(2);
  snprintf(library, sizeof library, "lib%s__rosidl_typesupport_c.so", package);
  snprintf(symbol, sizeof symbol, "rosidl_typesupport_c__get_message_type_support_handle__%s__msg__%s", package, name);
  void *opened = dlopen(library, RTLD_LAZY);
  void *found = opened ? dlsym(opened, symbol) : NULL;
  if (!found) {
    fprintf(stderr, "%s\n", dlerror());
    exit(1);
  }
  const rosidl_message_type_support_t *(*get)(void);
  memcpy(&get, &found, sizeof get);
  return get();
}

static rcl_serialized_message_t message_of(const char *hex) {
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_serialized_message_t message = rmw_get_zero_initialized_serialized_message();
  const size_t size = strlen(hex) / 2;
  if (rmw_serialized_message_init(&message, size, &allocator)) exit(1);
  for (size_t i = 0; i < size; i++) {
    const char digits[] = {hex[2 * i], hex[2 * i + 1], 0};
    message.buffer[i] = (uint8_t)strtoul(digits, NULL, 16);
  }
  message.buffer_length = size;
  return message;
}

/* Fills in one topic from a line. */
static void add(rcl_node_t *node, char *line) {
  char *words[7], *rest = line;
  for (int i = 0; i < 7; i++)
    if (!(words[i] = strtok_r(i ? NULL : line, " \n", &rest))) exit(2);
  struct topic *topic = &topics[count++];
  rcl_publisher_options_t options = rcl_publisher_get_default_options(); /* reliable, volatile, depth 10 */
  if (!strcmp(words[2], "best_effort")) options.qos.reliability = RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT;
  if (!strcmp(words[2], "transient_local")) options.qos.durability = RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL;
  topic->publisher = rcl_get_zero_initialized_publisher();
  check(rcl_publisher_init(&topic->publisher, node, type_support(words[1]), words[0], &options), words[0]);
  topic->period = (int64_t)(NS / atof(words[3]));
  topic->stamp = words[4][0];
  topic->offset = strtoul(words[5], NULL, 10);
  topic->message = message_of(words[6]);
}

static void read_topics(rcl_node_t *node, const char *path) {
  FILE *file = fopen(path, "r");
  char *line = NULL;
  size_t size = 0;
  if (!file) {
    perror(path);
    exit(1);
  }
  while (count < MOST_TOPICS && getline(&line, &size, file) > 0) add(node, line);
  free(line);
  fclose(file);
}

static void stamp(struct topic *topic) {
  struct timespec now;
  char text[32];
  uint8_t *at = topic->message.buffer + topic->offset;
  clock_gettime(CLOCK_REALTIME, &now);
  const int32_t sec = (int32_t)now.tv_sec;
  const uint32_t nanosec = (uint32_t)now.tv_nsec;
  const double seconds = (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
  switch (topic->stamp) {
    case 't':
      memcpy(at, &sec, sizeof sec);
      memcpy(at + sizeof sec, &nanosec, sizeof nanosec);
      break;
    case 'f': memcpy(at, &seconds, sizeof seconds); break;
    default:
      snprintf(text, sizeof text, "%017.6f", seconds);
      memcpy(at, text, 17);
  }
}

int main(int argc, char **argv) {
  (void)argc;
  check_options(argv, "ros_load [--topics FILE]");
  signal(SIGTERM, stop);
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  rcl_context_t context = rcl_get_zero_initialized_context();
  rcl_node_t node = rcl_get_zero_initialized_node();
  const rcl_node_options_t node_options = rcl_node_get_default_options();
  check(rcl_init_options_init(&options, rcl_get_default_allocator()), "init options");
  check(rcl_init(0, NULL, &options, &context), "rcl_init");
  check(rcl_node_init(&node, "ros_load", "", &context, &node_options), "node");
  read_topics(&node, option(argv, "--topics", 0, "/dev/stdin"));
  puts("{\"ready\": true}");
  fflush(stdout);

  /* Spread over the period, so that each moment is like any other. */
  const int64_t begin = monotonic_ns();
  for (int i = 0; i < count; i++) topics[i].due = begin + topics[i].period * i / count;
  int64_t published = 0, latest = 0;
  while (!stopping) {
    struct topic *next = topics;
    for (struct topic *topic = topics; topic < topics + count; topic++)
      if (topic->due < next->due) next = topic;
    const struct timespec until = {next->due / NS, next->due % NS};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR && !stopping) {
    }
    const int64_t late = monotonic_ns() - next->due;
    if (late > latest) latest = late;
    stamp(next);
    check(rcl_publish_serialized_message(&next->publisher, &next->message, NULL), "publish");
    published++;
    next->due += late > next->period ? late : next->period; /* what is missed is not caught up with */
  }
  printf("{\"published\": %lld, \"latest_ms\": %.3f}\n", (long long)published, (double)latest / 1e6);
  fflush(stdout);
  _Exit(0); /* everything else ends with the process */
}
