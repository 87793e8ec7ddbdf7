// The C++ peer: does per datagram what the C++ node that the router replaces does, and no more.
//
// inbound     one blocking recvfrom; sendto to both destinations, unconditionally; parse the whole
//             datagram as PBEnvelope; look the payload case up in a map of handler objects; the handler
//             (a virtual call) fills a ROS message field by field and publishes it, reliable, depth 10.
//             A case without a handler is a throttled warning.
// --outbound  a subscription in a wait set; one message taken per wake-up, as an executor does; its
//             envelope is built, serialized and sent to the first destination.
//
// It sits on the rcl C API, one layer below rclcpp: a little faster than a node of that kind can be, so
// a router that holds its own against this holds it against the original.

#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <rcutils/logging_macros.h>
#include <rosidl_runtime_c/message_type_support_struct.h>

#include <comms/msg/arm_board_target_movement.h>
#include <comms/msg/imu_sensor_information.h>
#include <comms/msg/sensor_board_diagnostics.h>
#include <comms/msg/sensor_board_gps_info.h>
#include <comms/msg/sensor_board_ph_info.h>

#include <signal.h>

#include <algorithm>
#include <memory>
#include <unordered_map>

#include "common.h"
#include "components/common/envelope.pb.h"

// The wheels' librcl.so needs libraries that are meant for Python extensions. Their functions are bound when
// called, hence never; but the loader insists on these two objects of libpython (exported by -rdynamic).
extern "C" {
void *PyExc_RuntimeError = nullptr;
void *_Py_TrueStruct[4] = {};
}

namespace {

volatile sig_atomic_t stopping = 0;
constexpr auto kLogger = "cpp_peer";

void check(rcl_ret_t result, const char *what) {
  if (result == RCL_RET_OK) return;
  std::fprintf(stderr, "%s: %s\n", what, rcl_get_error_string().str);
  std::exit(1);
}

// Enums travel as int32 in protobuf and as uint8 in ROS; what does not fit saturates.
uint8_t clamp_enum(int value) { return static_cast<uint8_t>(std::clamp(value, 0, 255)); }

void fill(comms__msg__ImuSensorInformation &out, const SensorBoardIMUInfo &in) {
  out.accel_x = in.accel_x();
  out.accel_y = in.accel_y();
  out.accel_z = in.accel_z();
  out.gyro_x = in.gyro_x();
  out.gyro_y = in.gyro_y();
  out.gyro_z = in.gyro_z();
  out.mag_x = in.mag_x();
  out.mag_y = in.mag_y();
  out.mag_z = in.mag_z();
  out.is_calibrated = in.is_calibrated();
  out.state.state = clamp_enum(in.state());
  out.error_code = clamp_enum(in.error_code());
}

void fill(comms__msg__SensorBoardGPSInfo &out, const SensorBoardGPSInfo &in) {
  out.latitude = in.latitude();
  out.longitude = in.longitude();
  out.altitude = in.altitude();
  out.speed = in.speed();
  out.heading = in.heading();
  out.hdop = in.hdop();
  out.vdop = in.vdop();
  out.satellites = in.satellites();
  out.fix_quality = clamp_enum(in.fix_quality());
  out.state.state = clamp_enum(in.state());
  out.error_code = clamp_enum(in.error_code());
  out.utc_timestamp = in.utc_timestamp();
}

void fill(comms__msg__SensorBoardPHInfo &out, const SensorBoardPHInfo &in) {
  out.ph_value = in.ph_value();
  out.voltage = in.voltage();
  out.temperature = in.temperature();
  out.state.state = clamp_enum(in.state());
  out.error_code = clamp_enum(in.error_code());
}

void fill(comms__msg__SensorBoardDiagnostics &out, const SensorBoardDiagnostics &in) {
  out.state = clamp_enum(in.state());
  fill(out.imu_sensor, in.imu_sensor());
  fill(out.gps_sensor, in.gps_sensor_1());
  fill(out.ph_sensor, in.ph_sensor());
  out.board_temperature = in.board_temperature();
  out.board_voltage = in.board_voltage();
}

struct Ros {
  rcl_context_t context = rcl_get_zero_initialized_context();
  rcl_node_t node = rcl_get_zero_initialized_node();

  explicit Ros(const char *name) {
    // The middleware's threads inherit this mask, so that a signal always interrupts our blocking call.
    sigset_t ours;
    sigemptyset(&ours);
    sigaddset(&ours, SIGTERM);
    sigaddset(&ours, SIGINT);
    pthread_sigmask(SIG_BLOCK, &ours, nullptr);
    rcl_init_options_t options = rcl_get_zero_initialized_init_options();
    check(rcl_init_options_init(&options, rcl_get_default_allocator()), "init options");
    check(rcl_init(0, nullptr, &options, &context), "rcl_init");
    const rcl_node_options_t node_options = rcl_node_get_default_options();
    check(rcl_node_init(&node, name, "", &context, &node_options), "node");
    pthread_sigmask(SIG_UNBLOCK, &ours, nullptr);
  }

  ~Ros() {
    check(rcl_node_fini(&node), "node");
    check(rcl_shutdown(&context), "shutdown");
    check(rcl_context_fini(&context), "context");
  }
};

class Handler {
 public:
  virtual ~Handler() = default;
  virtual void handle(const PBEnvelope &envelope) = 0;
};

template <class RosMessage, class Payload>
class PublishingHandler final : public Handler {
 public:
  using Getter = const Payload &(PBEnvelope::*)() const;

  PublishingHandler(Ros &ros, const char *topic, const rosidl_message_type_support_t *type, Getter payload)
      : ros_(ros), payload_(payload) {
    const rcl_publisher_options_t options = rcl_publisher_get_default_options();  // reliable, depth 10
    check(rcl_publisher_init(&publisher_, &ros.node, type, topic, &options), topic);
  }

  ~PublishingHandler() override { check(rcl_publisher_fini(&publisher_, &ros_.node), "publisher"); }

  void handle(const PBEnvelope &envelope) override {
    RosMessage message{};
    fill(message, (envelope.*payload_)());
    if (rcl_publish(&publisher_, &message, nullptr) != RCL_RET_OK) rcl_reset_error();
  }

 private:
  Ros &ros_;
  rcl_publisher_t publisher_ = rcl_get_zero_initialized_publisher();
  Getter payload_;
};

using Handlers = std::unordered_map<int, std::unique_ptr<Handler>>;

#define ADD_HANDLER(map, ros, payload_case, payload, getter, topic, message)                \
  (map)[PBEnvelope::payload_case] =                                                         \
      std::make_unique<PublishingHandler<comms__msg__##message, payload>>(                  \
          ros, topic, ROSIDL_GET_MSG_TYPE_SUPPORT(comms, msg, message), &PBEnvelope::getter)

Handlers make_handlers(Ros &ros) {
  Handlers map;
  ADD_HANDLER(map, ros, kImuInfo, SensorBoardIMUInfo, imu_info, "imu_data", ImuSensorInformation);
  ADD_HANDLER(map, ros, kGpsInfo, SensorBoardGPSInfo, gps_info, "gps_data", SensorBoardGPSInfo);
  ADD_HANDLER(map, ros, kPhInfo, SensorBoardPHInfo, ph_info, "ph_data", SensorBoardPHInfo);
  ADD_HANDLER(map, ros, kSensorDiag, SensorBoardDiagnostics, sensor_diag, "sensor_board_diagnostics",
              SensorBoardDiagnostics);
  return map;
}

void send_to(int fd, const void *bytes, size_t length, const sockaddr_in &to) {
  sendto(fd, bytes, length, 0, reinterpret_cast<const sockaddr *>(&to), sizeof to);
}

void run_inbound(int fd, const sockaddr_in &a, const sockaddr_in &b, const Handlers &handlers) {
  char bytes[MAX_DATAGRAM];
  while (!stopping) {
    sockaddr_in from{};
    socklen_t from_size = sizeof from;
    const ssize_t length = recvfrom(fd, bytes, sizeof bytes, 0, reinterpret_cast<sockaddr *>(&from), &from_size);
    if (length < 0) continue;
    send_to(fd, bytes, static_cast<size_t>(length), a);
    send_to(fd, bytes, static_cast<size_t>(length), b);
    PBEnvelope envelope;
    if (!envelope.ParseFromArray(bytes, static_cast<int>(length))) {
      RCUTILS_LOG_WARN_THROTTLE_NAMED(rcutils_steady_time_now, 5000, kLogger, "malformed datagram");
      continue;
    }
    const auto found = handlers.find(envelope.payload_case());
    if (found == handlers.end()) {
      RCUTILS_LOG_WARN_THROTTLE_NAMED(rcutils_steady_time_now, 5000, kLogger, "no handler for payload case %d",
                                      static_cast<int>(envelope.payload_case()));
      continue;
    }
    found->second->handle(envelope);
  }
}

using Outbound = comms__msg__ArmBoardTargetMovement;
const rosidl_message_type_support_t *outbound_type() {
  return ROSIDL_GET_MSG_TYPE_SUPPORT(comms, msg, ArmBoardTargetMovement);
}
constexpr auto kOutboundTopic = "arm_target";

void build(PBEnvelope &envelope, const Outbound &in) {
  ArmBoardTargetMovement &out = *envelope.mutable_arm_target();
  out.set_target_x(in.target_x);
  out.set_target_y(in.target_y);
  out.set_target_z(in.target_z);
  out.set_rotation_angle(in.rotation_angle);
  out.set_open_jaw(in.open_jaw);
  out.set_final_gripper_angle(in.final_gripper_angle);
}

void run_outbound(Ros &ros, int fd, const sockaddr_in &to) {
  rcl_subscription_t subscription = rcl_get_zero_initialized_subscription();
  const rcl_subscription_options_t options = rcl_subscription_get_default_options();  // reliable, depth 10
  check(rcl_subscription_init(&subscription, &ros.node, outbound_type(), kOutboundTopic, &options), kOutboundTopic);
  rcl_wait_set_t wait_set = rcl_get_zero_initialized_wait_set();
  check(rcl_wait_set_init(&wait_set, 1, 0, 0, 0, 0, 0, &ros.context, rcl_get_default_allocator()), "wait set");
  char bytes[MAX_DATAGRAM];
  Outbound message{};
  while (!stopping) {
    check(rcl_wait_set_clear(&wait_set), "wait set");
    check(rcl_wait_set_add_subscription(&wait_set, &subscription, nullptr), "wait set");
    if (rcl_wait(&wait_set, RCL_MS_TO_NS(200)) != RCL_RET_OK) {  // times out only to look at `stopping`
      rcl_reset_error();
      continue;
    }
    rmw_message_info_t info;
    if (rcl_take(&subscription, &message, &info, nullptr) != RCL_RET_OK) {
      rcl_reset_error();
      continue;
    }
    PBEnvelope envelope;
    build(envelope, message);
    const size_t length = envelope.ByteSizeLong();
    if (length <= sizeof bytes && envelope.SerializeToArray(bytes, static_cast<int>(length)))
      send_to(fd, bytes, length, to);
  }
  check(rcl_wait_set_fini(&wait_set), "wait set");
  check(rcl_subscription_fini(&subscription, &ros.node), "subscription");
}

}  // namespace

int main(int, char **argv) {
  check_options(argv, "cpp_peer [--listen A:P] [--to A:P --to A:P] [--rcvbuf BYTES] [--outbound]");
  const sockaddr_in listen_on = parse_address(option(argv, "--listen", 0, "0.0.0.0:5000"));
  const sockaddr_in a = parse_address(option(argv, "--to", 0, "127.0.0.1:6000"));
  const sockaddr_in b = parse_address(option(argv, "--to", 1, "127.0.0.1:6001"));
  struct sigaction action {};
  action.sa_handler = [](int) { stopping = 1; };
  sigaction(SIGTERM, &action, nullptr);
  sigaction(SIGINT, &action, nullptr);

  Ros ros("cpp_peer");
  if (flag(argv, "--outbound")) {
    run_outbound(ros, open_udp(parse_address("0.0.0.0:0"), 0), a);
  } else {
    const Handlers handlers = make_handlers(ros);
    run_inbound(open_udp(listen_on, std::atoi(option(argv, "--rcvbuf", 0, "0"))), a, b, handlers);
  }
}
