"""Opening and publishing against real rclpy, with the subscriber in a process of its own."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from time import monotonic, sleep

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

import std_msgs
from rclpy.duration import Duration
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from structlog.testing import capture_logs

from router.compiler.compiled_table import QosPlan, TopicPlan
from router.errors import StartError
from router.ros import events
from router.ros.qos import ActualQos, incompatible_policies
from router.ros.router_node import RouterNode
from router.types.ros import definition, ros_interfaces
from tests.ros.opening import HELLO, RELIABLE, SPAN, STRING, open_ros, string_topic
from tests.ros.peers import Publisher, Subscriber, wait_until


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peers are counted ten times as often."""
    monkeypatch.setattr(events, "CHECK_INTERVAL_NS", 100_000_000)


@pytest.fixture
def subscribe() -> Iterator[Callable[..., Subscriber]]:
    with ExitStack() as peers:
        yield lambda *arguments: peers.enter_context(closing(Subscriber(*arguments)))


def test_bytes_reach_a_subscriber_and_are_wanted_only_while_it_lives(subscribe: Callable[..., Subscriber]) -> None:
    with closing(open_ros(string_topic())) as ros:
        demand = ros.demands["greeting"]
        assert demand.wanted == 0
        peer = subscribe("greeting", "std_msgs/msg/String")
        wait_until(lambda: demand.wanted)
        assert peer.line() == "matched"
        ros.publish["greeting"](HELLO)
        assert bytes.fromhex(peer.line()) == HELLO
        peer.close()
        wait_until(lambda: not demand.wanted)


@pytest.mark.parametrize("args", [(), ("--ros-args", "-p", "start_type_description_service:=true")])
def test_there_is_no_service_that_nobody_would_answer(args: tuple[str, ...]) -> None:
    with closing(open_ros(args=args)) as ros:
        assert list(ros._node.services) == []


def test_what_late_joiners_get_is_wanted_before_they_come(subscribe: Callable[..., Subscriber]) -> None:
    with closing(open_ros(string_topic(QosPlan("reliable", "transient_local", "keep_last", 1)))) as ros:
        assert ros.demands["greeting"].wanted == 1
        ros.publish["greeting"](HELLO)
        peer = subscribe("greeting", "std_msgs/msg/String", "--transient-local")
        assert {peer.line(), peer.line()} == {"matched", HELLO.hex()}
        assert ros.demands["greeting"].wanted == 1


BEST_EFFORT = QosPlan("best_effort", "volatile", "keep_last", 5)


class Apart(dict[tuple[str, str], int]):
    """The last number that was reported for each topic and policy."""

    def __call__(self, topic: str, policy: str, peers: int) -> None:
        self[topic, policy] = peers

    def wait_for(self, *policies: str, topic: str = "greeting") -> None:
        """`policies`: one for each peer that it keeps away; no others are."""
        wanted = Counter(policies)
        wait_until(lambda: self and +Counter({p: n for (t, p), n in self.items() if t == topic}) == wanted)


@pytest.mark.slow
def test_peers_are_counted_by_policy_until_they_have_gone(subscribe: Callable[..., Subscriber]) -> None:
    apart = Apart()
    with closing(open_ros(string_topic(BEST_EFFORT), incompatible=apart)) as ros:
        one = subscribe("greeting", STRING)
        both = subscribe("greeting", STRING, "--transient-local")
        apart.wait_for("reliability", "reliability", "durability")
        both.close()
        apart.wait_for("reliability")
        one.close()
        apart.wait_for()
        subscribe("greeting", STRING, "--best-effort")  # it comes back as it should be
        wait_until(lambda: ros.demands["greeting"].wanted)
        apart.wait_for()
        subscribe("greeting", STRING)
        apart.wait_for("reliability")


def test_publishers_that_are_not_heard_are_counted_until_they_have_gone() -> None:
    apart = Apart()
    hearing = string_topic(QosPlan("reliable", "transient_local", "keep_last", 5))
    with closing(open_ros(subscriptions=[hearing], args=("--ros-args", "-r", "greeting:=salute"), incompatible=apart)):
        with closing(Publisher("salute", STRING, "--best-effort")), closing(Publisher("salute", STRING)):
            apart.wait_for("reliability", "durability", "durability")
        apart.wait_for()


SHORT_LEASE = """\
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="short" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseDuration><sec>2</sec></leaseDuration>
    <leaseAnnouncement><nanosec>500000000</nanosec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
</profiles>
"""


@pytest.mark.slow
def test_a_peer_that_was_killed_counts_until_its_lease_is_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "short.xml").write_text(SHORT_LEASE)  # 20 s without it
    apart = Apart()
    with closing(open_ros(string_topic(BEST_EFFORT), incompatible=apart)):
        with monkeypatch.context() as child:
            child.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(tmp_path / "short.xml"))
            peer = Subscriber("greeting", STRING)
        apart.wait_for("reliability")
        peer.kill()
        apart.wait_for()


def test_two_of_our_own_that_do_not_go_together_are_counted() -> None:
    apart = Apart()
    with closing(
        open_ros(string_topic(BEST_EFFORT), subscriptions=[string_topic(RELIABLE)], incompatible=apart)
    ) as ros:
        apart.wait_for("reliability", "reliability")
        change = ros.prepare([string_topic(RELIABLE)], [string_topic(RELIABLE)], {"greeting": SPAN})
        ros.adopt(change)
        ros.finish(change)
        apart.wait_for()


def test_policies_keep_apart_as_rclpy_says() -> None:
    def plan(reliability: str, durability: str, deadline: int | None, kind: str, lease: int | None) -> QosPlan:
        return QosPlan(reliability, durability, "keep_last", 5, deadline, None, kind, lease)

    asked = plan("reliable", "transient_local", 500_000_000, "manual_by_topic", 1_000_000)
    offers = itertools.product(
        ("best_effort", "reliable", "system_default"),
        ("volatile", "transient_local", "system_default"),
        (None, 1_000_000_000),
        (("automatic", None), ("automatic", 1_000_000), ("manual_by_topic", None)),
    )
    offered = {
        f"topic_{number}": plan(reliability, durability, deadline, *liveliness)
        for number, (reliability, durability, deadline, liveliness) in enumerate(offers)
    }
    published = [string_topic(qos, topic) for topic, qos in offered.items()]
    with closing(open_ros(*published, subscriptions=[string_topic(asked)])) as ros:
        theirs = ros._subscriptions["greeting"].qos
        qualities = {topic: ros._publications[topic].qos for topic in offered}
    for topic, ours in qualities.items():
        # what the middleware took for `system_default`
        assert ReliabilityPolicy.SYSTEM_DEFAULT not in (ours.reliability, ours.durability), offered[topic]
        policies = set(incompatible_policies(ours, theirs))
        verdict, why = qos_check_compatible(_profile(ours), _profile(theirs))
        assert bool(policies) == (verdict == QoSCompatibility.ERROR), (offered[topic], why)


def _profile(qos: ActualQos) -> QoSProfile:
    return QoSProfile(
        depth=1,
        reliability=qos.reliability,
        durability=qos.durability,
        deadline=Duration(nanoseconds=qos.deadline),
        liveliness=qos.liveliness,
        liveliness_lease_duration=Duration(nanoseconds=qos.lease),
    )


def test_a_fault_in_counting_an_event_is_told_and_costs_that_event_alone(subscribe: Callable[..., Subscriber]) -> None:
    def incompatible(*_: object) -> None:
        raise RuntimeError("no such series")

    offered = string_topic(QosPlan("best_effort", "volatile", "keep_last", 5)), string_topic(topic="farewell")
    with capture_logs() as logged, closing(open_ros(*offered, incompatible=incompatible)) as ros:
        subscribe("greeting", "std_msgs/msg/String")
        wait_until(lambda: len(logged) == 2)
        subscribe("farewell", "std_msgs/msg/String")
        wait_until(lambda: ros.demands["farewell"].wanted)
    assert [line["log_level"] for line in logged] == ["warning", "critical"]


def test_ros_that_others_shut_down_is_told_of() -> None:
    with capture_logs() as logged, closing(open_ros(string_topic())) as ros:
        ros._node.context.shutdown()
        wait_until(lambda: bool(logged))
        with pytest.raises(ros.publish_errors):
            ros.publish["greeting"](HELLO)
    assert logged[0]["log_level"] == "critical"


def test_ros_arguments_rename_topics(subscribe: Callable[..., Subscriber]) -> None:
    with closing(open_ros(string_topic(), args=("--ros-args", "-r", "greeting:=salute"))) as ros:
        peer = subscribe("salute", "std_msgs/msg/String")
        wait_until(lambda: ros.demands["greeting"].wanted)
        assert peer.line() == "matched"


def test_every_qos_that_a_table_can_name_opens() -> None:
    second = 1_000_000_000
    full = QosPlan("best_effort", "transient_local", "keep_all", 1, second, second, "manual_by_topic", second)
    defaults = QosPlan("system_default", "system_default", "system_default", 3)
    best = QosPlan("best_available", "best_available", "keep_last", 3)
    plans = [string_topic(full, "one"), string_topic(defaults, "two"), string_topic(best, "three")]
    with closing(open_ros(*plans, subscriptions=plans)) as ros:
        assert set(ros.publish) == {"one", "two", "three"}


def test_a_type_that_was_compiled_otherwise_is_refused() -> None:
    stale = (("data", "string"), ("more", "uint8"))
    with pytest.raises(StartError) as refused:
        open_ros(TopicPlan("greeting", "greeting", "std_msgs/msg/String", RELIABLE, {"std_msgs/msg/String": stale}))
    package = Path(std_msgs.__file__).parent
    assert refused.value.hint == "run 'make setup' and `. .venv/env.sh`, or install the ROS package 'std_msgs'"
    assert re.fullmatch(
        "routes/rover.yaml:40:16: the installed std_msgs/msg/String is not the one the table was compiled for: "
        rf"field 2 is missing in {package}, 'uint8 more' in .*/share/std_msgs/msg/String\.msg",
        refused.value.what,
    )


def test_a_type_with_one_in_it_that_was_compiled_otherwise_is_refused() -> None:
    interfaces = ros_interfaces()
    types = {name: interfaces.get(name) for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")}
    definitions = {name: definition(found) for name, found in types.items() if found}
    definitions["builtin_interfaces/msg/Time"] = (("sec", "int64"), ("nanosec", "uint32"))
    with pytest.raises(StartError, match="installed builtin_interfaces/msg/Time is not the one"):
        open_ros(TopicPlan("stamps", "stamps", "std_msgs/msg/Header", RELIABLE, definitions))


@pytest.mark.parametrize("type_name", ["no_such_msgs/msg/String", "std_msgs/msg/NoSuch"])
def test_a_type_that_is_not_installed_is_refused(type_name: str) -> None:
    missing = TopicPlan("greeting", "greeting", type_name, RELIABLE, {type_name: ()})
    with pytest.raises(StartError, match=rf"rover.yaml:40:16: {type_name} is not installed .* run 'make setup'"):
        open_ros(missing)


PARAMETERS = "/**: {ros__parameters: {use_sim_time: true}}\n"


@pytest.mark.parametrize(
    "args",
    [
        ("-p", "use_sim_time:=true"),
        ("-p", "router_test:use_sim_time:=true"),
        ("-r", "__node:=other", "-p", "other:use_sim_time:=true"),
        ("--params-file", "parameters.yaml"),
    ],
    ids=" ".join,
)
def test_simulated_time_is_ignored_with_one_warning_and_no_subscription(
    args: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("parameters.yaml").write_text(PARAMETERS)
    with capture_logs() as logs, closing(open_ros(string_topic(), args=("--ros-args", *args))) as ros:
        assert "/clock" not in ros.topics.names()
    [warning] = [line for line in logs if line["log_level"] == "warning"]
    assert warning["event"].startswith("use_sim_time is ignored")
    assert "leave use_sim_time out" in warning["remedy"]


@pytest.mark.parametrize("parameter", ["use_sim_time:=false", "someone_else:use_sim_time:=true"])
def test_real_time_is_no_warning(parameter: str) -> None:
    with capture_logs() as logs, closing(open_ros(string_topic(), args=("--ros-args", "-p", parameter))):
        assert [line for line in logs if line["log_level"] == "warning"] == []


def test_a_parameter_of_a_wrong_type_is_refused() -> None:
    with pytest.raises(StartError, match=r"ROS node cannot be created: .*use_sim_time"):
        open_ros(string_topic(), args=("--ros-args", "-p", "use_sim_time:=1"))


def test_bad_ros_arguments_are_refused() -> None:
    with pytest.raises(StartError, match="ROS node cannot be created"):
        open_ros(string_topic(), args=("--ros-args", "-r", "not a rule"))


def test_an_impossible_name_is_refused_and_nothing_stays_open() -> None:
    with pytest.raises(StartError, match=r"rover.yaml:40:16: topic '2bad' cannot be published"):
        open_ros(string_topic(), string_topic(topic="2bad"))
    with closing(open_ros(string_topic())) as ros:
        ros.publish["greeting"](HELLO)


@pytest.fixture
def blocked() -> Iterator[RouterNode]:
    """A topic whose next `publish` blocks: it keeps all, and is full of what a stopped subscriber has not taken."""
    with closing(open_ros(string_topic(QosPlan("reliable", "volatile", "keep_all", 1)))) as ros:
        peer = Subscriber("greeting", "std_msgs/msg/String")
        try:
            assert peer.line() == "matched"
            wait_until(lambda: ros.demands["greeting"].wanted)
            peer.process.send_signal(signal.SIGSTOP)
            with suppress(*ros.publish_errors):
                while True:
                    ros.publish["greeting"](HELLO)
            yield ros
        finally:
            peer.kill()


def test_python_goes_on_while_the_middleware_blocks_a_publisher(blocked: RouterNode) -> None:
    ran_at: list[float] = []
    stalled: list[float] = []
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            ran_at.append(monotonic())
            stalled.extend(seconds for _, seconds in blocked.stalled())
            sleep(0.001)

    other = threading.Thread(target=run)
    other.start()
    begun = monotonic()
    with pytest.raises(blocked.publish_errors):
        blocked.publish["greeting"](HELLO)
    lasted = monotonic() - begun
    ended.set()
    other.join()
    assert any(lasted / 4 < at - begun < lasted * 3 / 4 for at in ran_at)
    assert lasted / 4 < max(stalled) <= lasted
    assert not list(blocked.stalled())


def test_a_publisher_closes_when_nobody_is_in_it_and_refuses_after_that(blocked: RouterNode) -> None:
    publish, refusals, calls = blocked.publish["greeting"], [], blocked._publications["greeting"]._calls

    def try_to_publish() -> None:
        with pytest.raises(blocked.publish_errors) as refused:
            publish(HELLO)
        refusals.append(str(refused.value))

    other = threading.Thread(target=try_to_publish)
    other.start()
    wait_until(lambda: bool(calls))
    blocked.close()
    other.join()
    try_to_publish()
    assert ["closed" in each for each in refusals] == [False, True]


_UDP_ONLY = """
import sys
from router.clock import monotonic_ns
from tests.ros.opening import HELLO, open_ros, string_topic
ros = open_ros(string_topic())
with open("/proc/self/maps") as maps:
    print(sum("/dev/shm/fastrtps" in line for line in maps), flush=True)
while not ros.demands["greeting"].wanted:
    pass
sys.stdin.readline()
ros.publish["greeting"](HELLO)
sys.stdin.read()
ros.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize(("transports", "shares"), [("UDPv4", False), ("DEFAULT", True)])
def test_udp_alone_is_used_where_the_environment_says_so(
    subscribe: Callable[..., Subscriber], transports: str, shares: bool
) -> None:
    """With discovery on this computer only, which takes more than that variable; our peer has shared memory as well."""
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "FASTDDS_BUILTIN_TRANSPORTS": transports}
    command = [sys.executable, "-c", _UDP_ONLY]
    peer = subscribe("greeting", "std_msgs/msg/String")
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as publisher:
        assert publisher.stdout
        assert publisher.stdin
        assert (int(publisher.stdout.readline()) > 0) == shares
        assert peer.line() == "matched"
        publisher.stdin.write("publish\n")
        publisher.stdin.flush()
        assert bytes.fromhex(peer.line()) == HELLO
        publisher.stdin.close()
    assert publisher.returncode == 0
