// The gateway peer: does what the C++ gateway does that the router's gateways replace, and no more.
//
// every 5 s     list the topics; subscribe to those that are asked for (all without --topics), reliable, volatile,
//               depth 1, with the first type of each; forget those that are gone, though their timers go on
// per message   find the type's introspection library, deserialize, build a JSON document of all of it, dump it,
//               compress it with --compression; keep the text
// every 500 ms  per topic: header and latest text in one datagram, and a line of the log
// every 5 s     per topic: the same with its schema
//
// It sits on the rcl C API, one layer below rclcpp, and spins as rclcpp's single-threaded executor does: one wait set
// of everything, filled again for each turn; then what is ready, one after the other, timers first, one message per
// subscription. The two events that rclcpp waits for with each subscription are in it too.
//
// Where it differs:
// - Deserializing goes by the generated code of Fast DDS, which does not know the introspection's handle; the original
//   needs a middleware that does. The message in memory is the same.
// - The introspection library of a topic stays loaded (with such a middleware it would be anyway); it is looked up and
//   opened again for every message, as in the original.
// - A sequence of bool ends the original: it has no get_const_function. Here it is read by fetch_function.
// - No parameter services, 8 of about 800 things to wait for.
// - Nothing is received: the original throws away what comes.
// So it is a little faster than the node can be.

#include <ament_index_cpp/get_package_prefix.hpp>
#include <nlohmann/json.hpp>
#include <rcl/error_handling.h>
#include <rcl/event.h>
#include <rcl/graph.h>
#include <rcl/logging.h>
#include <rcl/rcl.h>
#include <rcl/timer.h>
#include <rcpputils/find_library.hpp>
#include <rcpputils/shared_library.hpp>
#include <rcutils/logging_macros.h>
#include <rmw/rmw.h>
#include <rosidl_typesupport_introspection_cpp/field_types.hpp>
#include <rosidl_typesupport_introspection_cpp/message_introspection.hpp>
#include <zstd.h>

#include <signal.h>

#include <chrono>
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <unordered_set>
#include <vector>

#include "common.h"

// The wheels' librcl.so needs libraries that are meant for Python extensions. Their functions are bound when
// called, hence never; but the loader insists on these two objects of libpython (exported by -rdynamic).
extern "C" {
void *PyExc_RuntimeError = nullptr;
void *_Py_TrueStruct[4] = {};
}

namespace {

namespace introspection = rosidl_typesupport_introspection_cpp;
using introspection::MessageMember;
using introspection::MessageMembers;
using nlohmann::json;
using Bytes = std::vector<uint8_t>;
using Library = std::shared_ptr<rcpputils::SharedLibrary>;

volatile sig_atomic_t stopping = 0;
constexpr auto kLogger = "network_gateway";

void check(rcl_ret_t result, const char *what) {
  if (result == RCL_RET_OK) return;
  std::fprintf(stderr, "%s: %s\n", what, rcl_get_error_string().str);
  std::exit(1);
}

// ---- Types: libraries and what they say -----------------------------------------------------------------------------

// As rclcpp finds it: by the index of packages, on the disk.
Library type_library(const std::string &type, const std::string &kind) {
  const std::string package = type.substr(0, type.find('/'));
  const std::string folder = ament_index_cpp::get_package_prefix(package) + "/lib";
  return std::make_shared<rcpputils::SharedLibrary>(rcpputils::path_for_library(folder, package + "__" + kind));
}

const rosidl_message_type_support_t *type_support(const std::string &type, const std::string &kind, Library &library) {
  const auto first = type.find('/'), last = type.rfind('/');
  const std::string symbol = kind + "__get_message_type_support_handle__" + type.substr(0, first) + "__" +
                             type.substr(first + 1, last - first - 1) + "__" + type.substr(last + 1);
  using Getter = const rosidl_message_type_support_t *(*)();
  return reinterpret_cast<Getter>(library->get_symbol(symbol))();
}

const MessageMembers *members_of(const rosidl_message_type_support_t *support) {
  return static_cast<const MessageMembers *>(support->data);
}

std::string type_name(uint8_t id) {
  switch (id) {
    case introspection::ROS_TYPE_BOOLEAN: return "bool";
    case introspection::ROS_TYPE_OCTET: return "byte";
    case introspection::ROS_TYPE_CHAR: return "char";
    case introspection::ROS_TYPE_FLOAT: return "float32";
    case introspection::ROS_TYPE_DOUBLE: return "float64";
    case introspection::ROS_TYPE_INT8: return "int8";
    case introspection::ROS_TYPE_UINT8: return "uint8";
    case introspection::ROS_TYPE_INT16: return "int16";
    case introspection::ROS_TYPE_UINT16: return "uint16";
    case introspection::ROS_TYPE_INT32: return "int32";
    case introspection::ROS_TYPE_UINT32: return "uint32";
    case introspection::ROS_TYPE_INT64: return "int64";
    case introspection::ROS_TYPE_UINT64: return "uint64";
    case introspection::ROS_TYPE_STRING: return "string";
    case introspection::ROS_TYPE_WSTRING: return "wstring";
    case introspection::ROS_TYPE_MESSAGE: return "message";
    default: return "unknown";
  }
}

json schema_of(const MessageMembers *members) {
  json fields = json::array();
  for (uint32_t i = 0; i < members->member_count_; ++i) {
    const MessageMember &member = members->members_[i];
    const bool nested = member.type_id_ == introspection::ROS_TYPE_MESSAGE;
    fields.push_back({{"name", member.name_},
                      {"is_array", member.is_array_},
                      {"type", type_name(member.type_id_)},
                      {"subtype", nested ? schema_of(members_of(member.members_)) : json("primitive")}});
  }
  return {{"name", members->message_name_}, {"namespace", members->message_namespace_}, {"fields", fields}};
}

// ---- A message as JSON ----------------------------------------------------------------------------------------------

template <class T>
json value_of(const void *at) {
  return *static_cast<const T *>(at);
}

json scalar_json(uint8_t id, const void *at) {
  switch (id) {
    case introspection::ROS_TYPE_FLOAT: return value_of<float>(at);
    case introspection::ROS_TYPE_DOUBLE: return value_of<double>(at);
    case introspection::ROS_TYPE_LONG_DOUBLE: return value_of<long double>(at);
    case introspection::ROS_TYPE_WCHAR: return value_of<char16_t>(at);
    case introspection::ROS_TYPE_BOOLEAN: return value_of<bool>(at);
    case introspection::ROS_TYPE_CHAR:
    case introspection::ROS_TYPE_OCTET:
    case introspection::ROS_TYPE_UINT8: return value_of<uint8_t>(at);
    case introspection::ROS_TYPE_INT8: return value_of<int8_t>(at);
    case introspection::ROS_TYPE_UINT16: return value_of<uint16_t>(at);
    case introspection::ROS_TYPE_INT16: return value_of<int16_t>(at);
    case introspection::ROS_TYPE_UINT32: return value_of<uint32_t>(at);
    case introspection::ROS_TYPE_INT32: return value_of<int32_t>(at);
    case introspection::ROS_TYPE_UINT64: return value_of<uint64_t>(at);
    case introspection::ROS_TYPE_INT64: return value_of<int64_t>(at);
    case introspection::ROS_TYPE_STRING: return value_of<std::string>(at);
    case introspection::ROS_TYPE_WSTRING: return value_of<std::u16string>(at);
    default: return json::array({"<unhandled>"});
  }
}

json message_json(const void *message, const MessageMembers *members);

json element_json(const MessageMember &member, const void *at) {
  if (member.type_id_ == introspection::ROS_TYPE_MESSAGE) return message_json(at, members_of(member.members_));
  return scalar_json(member.type_id_, at);
}

json field_json(const MessageMember &member, const void *field) {
  json found = json::array();
  if (!member.is_array_) {
    found.push_back(element_json(member, field));
    return found;
  }
  const size_t size = member.size_function(field);
  for (size_t i = 0; i < size; i++) {
    if (member.get_const_function) {
      found.push_back(element_json(member, member.get_const_function(field, i)));
    } else {  // std::vector<bool>
      bool value = false;
      member.fetch_function(field, i, &value);
      found.push_back(value);
    }
  }
  return found;
}

json message_json(const void *message, const MessageMembers *members) {
  json found = json::object();
  for (uint32_t i = 0; i < members->member_count_; i++) {
    const MessageMember &member = members->members_[i];
    const json field = field_json(member, static_cast<const uint8_t *>(message) + member.offset_);
    found[member.name_] = field;  // a copy, as the original makes one
  }
  return found;
}

std::string compressed(const std::string &text, int level) {
  std::string found(ZSTD_compressBound(text.size()), '\0');
  const size_t size = ZSTD_compress(found.data(), found.size(), text.data(), text.size(), level);
  if (ZSTD_isError(size)) throw std::runtime_error(ZSTD_getErrorName(size));
  found.resize(size);
  return found;
}

// ---- ROS ------------------------------------------------------------------------------------------------------------

struct Ros {
  rcl_context_t context = rcl_get_zero_initialized_context();
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_clock_t clock{};
  rcl_allocator_t allocator = rcl_get_default_allocator();

  explicit Ros(const char *log_level) {
    // The middleware's threads inherit this mask, so that a signal always interrupts our blocking call.
    sigset_t ours;
    sigemptyset(&ours);
    sigaddset(&ours, SIGTERM);
    sigaddset(&ours, SIGINT);
    pthread_sigmask(SIG_BLOCK, &ours, nullptr);
    rcl_init_options_t options = rcl_get_zero_initialized_init_options();
    check(rcl_init_options_init(&options, allocator), "init options");
    const char *arguments[] = {kLogger, "--ros-args", "--log-level", log_level};
    check(rcl_init(4, arguments, &options, &context), "rcl_init");
    check(rcl_logging_configure(&context.global_arguments, &allocator), "logging");
    const rcl_node_options_t node_options = rcl_node_get_default_options();
    check(rcl_node_init(&node, kLogger, "", &context, &node_options), "node");
    check(rcl_clock_init(RCL_STEADY_TIME, &clock, &allocator), "clock");
    pthread_sigmask(SIG_UNBLOCK, &ours, nullptr);
  }
};

class Timer {
 public:
  Timer(Ros &ros, int64_t ms, std::function<void()> action) : action_(std::move(action)) {
    const int64_t ns = RCL_MS_TO_NS(ms);
    check(rcl_timer_init2(&timer, &ros.clock, &ros.context, ns, nullptr, ros.allocator, true), "timer");
  }

  void run() {
    if (rcl_timer_call(&timer) == RCL_RET_OK) action_();
  }

  rcl_timer_t timer = rcl_get_zero_initialized_timer();

 private:
  std::function<void()> action_;
};

// ---- One topic ------------------------------------------------------------------------------------------------------

constexpr auto kCpp = "rosidl_typesupport_cpp";
constexpr auto kIntrospection = "rosidl_typesupport_introspection_cpp";

class Topic {
 public:
  Topic(Ros &ros, std::string name, std::string type, int level)
      : name(std::move(name)), type(std::move(type)), ros_(ros), level_(level),
        library_(type_library(this->type, kCpp)), kept_(type_library(this->type, kIntrospection)),
        support_(type_support(this->type, kCpp, library_)) {
    rcl_subscription_options_t options = rcl_subscription_get_default_options();  // reliable, volatile
    options.qos.depth = 1;
    check(rcl_subscription_init(&subscription, &ros.node, support_, this->name.c_str(), &options), this->name.c_str());
    for (auto kind : {RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS, RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE}) {
      rcl_event_t event = rcl_get_zero_initialized_event();
      if (rcl_subscription_event_init(&event, &subscription, kind) == RCL_RET_OK) events.push_back(event);
      else rcl_reset_error();
    }
  }

  Topic(const Topic &) = delete;

  ~Topic() { close(); }

  // What is not there any more is sent on, though nothing new comes.
  void close() {
    if (!subscription.impl) return;
    for (rcl_event_t &event : events) check(rcl_event_fini(&event), "event");
    events.clear();
    check(rcl_subscription_fini(&subscription, &ros_.node), "subscription");
  }

  void take() {
    auto message = std::make_shared<rmw_serialized_message_t>(rmw_get_zero_initialized_serialized_message());
    check(rmw_serialized_message_init(message.get(), 0, &ros_.allocator), "message");
    rmw_message_info_t info;
    if (rcl_take_serialized_message(&subscription, message.get(), &info, nullptr) == RCL_RET_OK) handle(*message);
    else rcl_reset_error();
    check(rmw_serialized_message_fini(message.get()), "message");
  }

  std::string data() {
    std::lock_guard lock(mutex_);
    return data_;
  }

  std::string schema() {
    std::lock_guard lock(mutex_);
    return data_.empty() ? "" : schema_;
  }

  bool is_compressed() const { return level_ > 0; }

  const std::string name, type;
  rcl_subscription_t subscription = rcl_get_zero_initialized_subscription();
  std::vector<rcl_event_t> events;

 private:
  void handle(const rmw_serialized_message_t &message) {
    Library library = type_library(type, kIntrospection);
    const MessageMembers *members = members_of(type_support(type, kIntrospection, library));
    {
      std::lock_guard lock(mutex_);
      if (schema_.empty()) schema_ = schema_of(members).dump();
    }
    Bytes memory(members->size_of_);
    members->init_function(memory.data(), rosidl_runtime_cpp::MessageInitialization::ALL);
    if (rmw_deserialize(&message, support_, memory.data()) == RMW_RET_OK) {
      keep(message_json(memory.data(), members));
    } else {
      RCUTILS_LOG_ERROR_NAMED(kLogger, "Deserialization failed for topic %s", name.c_str());
      rcutils_reset_error();
    }
    members->fini_function(memory.data());
  }

  void keep(const json &document) {
    try {
      std::string text = document.dump();
      if (level_ > 0) text = compressed(text, level_);
      std::lock_guard lock(mutex_);
      data_ = std::move(text);
    } catch (const std::exception &error) {  // text that is no UTF-8
      RCUTILS_LOG_ERROR_NAMED(kLogger, "Failed to serialize/compress message: %s", error.what());
    }
  }

  Ros &ros_;
  const int level_;
  Library library_, kept_;
  const rosidl_message_type_support_t *support_;
  std::mutex mutex_;
  std::string data_, schema_;
};

// ---- The gateway ----------------------------------------------------------------------------------------------------

struct Settings {
  std::set<std::string> topics;  // empty: all
  int refresh_ms, publish_ms, schema_ms, level;
  sockaddr_in listen_on, to;
};

class Gateway {
 public:
  Gateway(Ros &ros, const Settings &settings) : ros_(ros), settings_(settings), fd_(open_udp(settings.listen_on, 0)) {
    timers_.emplace_back(ros_, settings_.refresh_ms, [this] { look(); });
    timers_.emplace_back(ros_, 500, [this] {  // the check of the network interface
      if (!has_failed_) return;
      RCUTILS_LOG_WARN_NAMED(kLogger, "Network interface has failed. Resetting");
      close(fd_);
      fd_ = open_udp(settings_.listen_on, 0);
      has_failed_ = false;
    });
  }

  void spin() {
    rcl_wait_set_t wait_set = rcl_get_zero_initialized_wait_set();
    check(rcl_wait_set_init(&wait_set, 0, 0, 0, 0, 0, 0, &ros_.context, ros_.allocator), "wait set");
    while (!stopping) {
      turn(wait_set);
    }
    check(rcl_wait_set_fini(&wait_set), "wait set");
  }

 private:
  void turn(rcl_wait_set_t &wait_set) {
    // What a timer's action changes, this turn does not see.
    const std::vector<std::shared_ptr<Topic>> topics(topics_);
    std::vector<Timer *> timers;
    for (Timer &timer : timers_) timers.push_back(&timer);
    size_t events = 0;
    for (const auto &topic : topics) events += topic->events.size();
    if (wait_set.size_of_subscriptions != topics.size() || wait_set.size_of_timers != timers.size())
      check(rcl_wait_set_resize(&wait_set, topics.size(), 0, timers.size(), 0, 0, events), "wait set");
    check(rcl_wait_set_clear(&wait_set), "wait set");
    for (const auto &topic : topics) {
      check(rcl_wait_set_add_subscription(&wait_set, &topic->subscription, nullptr), "wait set");
      for (const rcl_event_t &event : topic->events) check(rcl_wait_set_add_event(&wait_set, &event, nullptr), "event");
    }
    for (Timer *timer : timers) check(rcl_wait_set_add_timer(&wait_set, &timer->timer, nullptr), "wait set");
    if (rcl_wait(&wait_set, -1) != RCL_RET_OK) rcl_reset_error();
    if (stopping) return;
    std::vector<bool> ready;
    for (size_t i = 0; i < topics.size(); i++) ready.push_back(wait_set.subscriptions[i] != nullptr);
    for (size_t i = 0; i < timers.size(); i++)
      if (wait_set.timers[i]) timers[i]->run();
    for (size_t i = 0; i < topics.size(); i++)
      if (ready[i] && topics[i]->subscription.impl) topics[i]->take();
  }

  void look() {
    RCUTILS_LOG_INFO_NAMED(kLogger, "Subscribing to topics from the ROS2 graph ...");
    rcl_names_and_types_t found = rcl_get_zero_initialized_names_and_types();
    check(rcl_get_topic_names_and_types(&ros_.node, &ros_.allocator, false, &found), "topics");
    std::unordered_set<std::string> present;
    for (size_t i = 0; i < found.names.size; i++) {
      const std::string name = found.names.data[i];
      present.insert(name);
      if (!found.types[i].size || (!settings_.topics.empty() && !settings_.topics.count(name))) continue;
      if (known_.insert(name).second) follow(name, found.types[i].data[0]);
    }
    check(rcl_names_and_types_fini(&found), "topics");
    for (auto it = topics_.begin(); it != topics_.end();) {
      if (present.count((*it)->name)) {
        ++it;
        continue;
      }
      RCUTILS_LOG_WARN_NAMED(kLogger, "Topic %s disappeared", (*it)->name.c_str());
      known_.erase((*it)->name);
      (*it)->close();
      it = topics_.erase(it);
    }
  }

  void follow(const std::string &name, const std::string &type) {
    RCUTILS_LOG_INFO_NAMED(kLogger, "Found topic %s of type %s", name.c_str(), type.c_str());
    auto topic = std::make_shared<Topic>(ros_, name, type, settings_.level);
    topics_.push_back(topic);
    timers_.emplace_back(ros_, settings_.schema_ms, [this, topic] { send(*topic, topic->schema(), false); });
    timers_.emplace_back(ros_, settings_.publish_ms, [this, topic] {
      send(*topic, topic->data(), topic->is_compressed());
    });
  }

  void send(const Topic &topic, const std::string &payload, bool is_compressed) {
    if (payload.empty()) return;
    const std::chrono::duration<double> since_epoch = std::chrono::system_clock::now().time_since_epoch();
    const double now = since_epoch.count();
    Bytes packet(sizeof now + 1);
    std::memcpy(packet.data(), &now, sizeof now);
    packet[sizeof now] = is_compressed;
    packet.insert(packet.end(), topic.name.begin(), topic.name.end());
    packet.push_back('\0');
    packet.insert(packet.end(), topic.type.begin(), topic.type.end());
    packet.push_back('\0');
    packet.insert(packet.end(), payload.begin(), payload.end());
    const std::string shown(packet.begin(), packet.end());
    RCUTILS_LOG_INFO_NAMED(kLogger, "Sending message: %s", shown.c_str());
    const auto *to = reinterpret_cast<const sockaddr *>(&settings_.to);
    if (sendto(fd_, packet.data(), packet.size(), 0, to, sizeof settings_.to) < 0) has_failed_ = true;
  }

  Ros &ros_;
  const Settings settings_;
  int fd_;
  bool has_failed_ = false;
  std::vector<std::shared_ptr<Topic>> topics_;
  std::set<std::string> known_;
  std::list<Timer> timers_;
};

std::set<std::string> words(const std::string &text) {
  std::set<std::string> found;
  for (size_t begin = 0; begin < text.size();) {
    const size_t end = std::min(text.find(',', begin), text.size());
    found.insert(text.substr(begin, end - begin));
    begin = end + 1;
  }
  return found;
}

}  // namespace

int main(int, char **argv) {
  check_options(argv, "gateway_peer [--listen A:P] [--to A:P] [--topics NAME,NAME] [--refresh-ms N] [--publish-ms N]"
                      " [--schema-ms N] [--compression LEVEL] [--log-level LEVEL]");
  const auto number = [&](const char *name, const char *fallback) {
    return std::atoi(option(argv, name, 0, fallback));
  };
  Settings settings{words(option(argv, "--topics", 0, "")),
                    number("--refresh-ms", "5000"),
                    number("--publish-ms", "500"),
                    number("--schema-ms", "5000"),
                    number("--compression", "0"),
                    parse_address(option(argv, "--listen", 0, "127.0.0.1:0")),
                    parse_address(option(argv, "--to", 0, "127.0.0.1:8502"))};
  struct sigaction action {};
  action.sa_handler = [](int) { stopping = 1; };
  sigaction(SIGTERM, &action, nullptr);
  sigaction(SIGINT, &action, nullptr);
  Ros ros(option(argv, "--log-level", 0, "info"));
  Gateway(ros, settings).spin();
  std::_Exit(0);  // everything else ends with the process
}
