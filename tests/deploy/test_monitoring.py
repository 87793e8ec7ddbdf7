"""A running router, the real Prometheus and our rules: every series exists, every query has an answer, alerts fire."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.request import urlopen

import pytest
from prometheus_client.parser import text_string_to_metric_families
from websockets.sync.client import connect

from router.tools.running_router import post
from tests.acceptance.payloads import generated
from tests.acceptance.rover_map import FLOWS
from tests.acceptance.site import ROVER, RouterProcess, Site, site, wait_until
from tests.deploy.dashboard import queries
from tests.deploy.prometheus_server import PROGRAM, PrometheusServer
from tests.deploy.promql import selectors
from tests.deploy.test_prometheus import ALERTS, RECORDED
from tests.ports import free_port

pytestmark = pytest.mark.slow

MONITORED = (
    ROVER.replace("acceptance/patient.yaml", "rover/routes/rover.yaml").replace(
        "endpoints:\n",
        "  drill_line: {{serial: @drill, baud: 115200, framing: cobs}}\n"
        "endpoints:\n"
        "  drill: {{listener: drill_line, kind: board}}\n",
    )
    + """
gateways:
  dashboard:
    transport: {{websocket: 127.0.0.1:@gateway}}
    inbound: [{{topic: cmd_vel, type: geometry_msgs/msg/Twist}}]
record: {{directory: recordings, continuous: true}}
foxglove: {{address: 127.0.0.1:@foxglove}}
state:
  mode: {{case: control_mode, source: basestation, value: mode, initial: MODE_MANUAL}}
  driver: {{topic: driver, type: std_msgs/msg/String, value: data, initial: "'nobody'"}}
"""
)
"""The rover, with all that has metrics, and its own times for what is silent and for its deadmen."""

MADE_BY_PROMETHEUS = {"up"}
OF_OTHER_TABLES = {
    "router_messages_collected_total", "router_gateway_connections", "router_deadman_disobeyed",
    "router_groups_not_joined", "router_endpoint_unresolved", "router_messages_split_total",
}  # fmt: skip
"""The rover has no route that collects, `for_each`, Zenoh gateway, deadman with `obeyed`, multicast group or host
name."""
OF_OTHERS = {"router_type_incompatible", "router_other_routers"}
"""Nobody else is in the ROS domain."""
OF_SILENT_ENDPOINTS = {"instance_endpoint_target_reason:router_messages_dropped:rate1m"}
"""All endpoints answer."""


@dataclass
class Traffic:
    """Every case from who sends it, ten times a second, but for what is `paused`."""

    place: Site
    paused: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._datagrams = {case: next(generated(case)).datagram for case in FLOWS}
        self._end = Event()
        self._thread = Thread(target=self._run)

    def __enter__(self) -> Traffic:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(0.1):
            for case in FLOWS.keys() - self.paused:
                self.place.send(FLOWS[case].source, self._datagrams[case])
            self.place.waiting()


class Plug:
    """A pty as a serial device at `path`, while it is plugged in."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.plug_in()

    def plug_in(self) -> None:
        self._board, device = os.openpty()
        self._path.symlink_to(os.ttyname(device))
        os.close(device)

    def pull(self) -> None:
        self._path.unlink()
        os.close(self._board)


@dataclass
class Monitored:
    """`address` is that of its metrics."""

    address: str
    traffic: Traffic
    table: Path
    drill: Plug

    def reload(self) -> bool:
        """Whether the router runs the table now."""
        return post(f"http://{self.address}", "/-/reload", 10).ok


@pytest.fixture(scope="module")
def monitored(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Monitored]:
    """A router with traffic, and a browser at its gateway."""
    folder = tmp_path_factory.mktemp("monitored")
    gateway, foxglove = free_port(kind=socket.SOCK_STREAM), free_port(kind=socket.SOCK_STREAM)
    text = MONITORED.replace("@gateway", str(gateway)).replace("@foxglove", str(foxglove))
    text, drill = text.replace("@drill", str(folder / "drill")), Plug(folder / "drill")
    with (
        site(folder) as place,
        RouterProcess(folder, table := place.table(text)),
        connect(f"ws://127.0.0.1:{gateway}", close_timeout=0.1),  # it reads nothing, so that it is behind
        Traffic(place) as traffic,
    ):
        yield Monitored(f"127.0.0.1:{place.metrics}", traffic, table, drill)
    drill.pull()


@pytest.fixture(scope="module")
def prometheus(monitored: Monitored, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PrometheusServer]:
    if PROGRAM is None:
        pytest.skip("prometheus is not installed; it is a package of Debian's")
    with PrometheusServer(tmp_path_factory.mktemp("prometheus"), monitored.address) as server:
        wait_until(lambda: bool(server.query("sum_over_time(up[1m]) > 2")), "the third scrape")
        yield server


CHOSEN = {"__rate_interval": "1m", "route": ".+", "listener": ".+", "endpoint": ".+", "gateway": "dashboard"}
"""The values of the dashboard's variables but for `instance`."""


def filled(row: str | None = None, **values: str) -> list[str]:
    return queries({**CHOSEN, **values}, row)


EXPRESSIONS = {*filled(instance="any"), *(alert["expr"] for alert in ALERTS.values()), *RECORDED.values()}


def scraped(monitored: Monitored) -> str:
    with urlopen(f"http://{monitored.address}/metrics", timeout=10) as answer:
        return str(answer.read().decode())


def test_every_series_that_dashboard_rules_and_alerts_ask_for_is_exposed(monitored: Monitored) -> None:
    wait_until(lambda: "router_endpoint_silence_seconds{" in scraped(monitored), "the first datagram")
    families = text_string_to_metric_families(scraped(monitored))
    exposed = [(sample.name, sample.labels) for family in families for sample in family.samples]
    asked = {selector for expression in EXPRESSIONS for selector in selectors(expression)}
    missing = [
        selector
        for selector in asked
        if selector.metric not in MADE_BY_PROMETHEUS | OF_OTHER_TABLES | OF_OTHERS | set(RECORDED)
        and not any(selector.selects(name, labels) for name, labels in exposed)
    ]
    assert asked
    assert missing == []


def test_the_rover_is_scraped_as_it_is_configured(monitored: Monitored, prometheus: PrometheusServer) -> None:
    [target] = prometheus.query("up")
    assert target["metric"] == {"__name__": "up", "job": "rover_router", "instance": monitored.address}
    assert target["value"][1] == "1"


def test_every_rule_records_something(prometheus: PrometheusServer) -> None:
    wait_until(
        lambda: all(prometheus.query(name) for name in RECORDED.keys() - OF_SILENT_ENDPOINTS), "the first evaluation"
    )


def test_every_query_of_the_dashboard_has_an_answer(monitored: Monitored, prometheus: PrometheusServer) -> None:
    """Those that leave out what is 0 may have none: there all is well, or nothing came."""
    empty = []
    for query in filled(instance=monitored.address):
        assert "$" not in query
        if not prometheus.query(query) and not query.endswith("> 0"):
            empty.append(query)
    assert empty == []


@pytest.mark.parametrize("case", FLOWS)
def test_a_routes_panels_show_what_it_does(case: str, monitored: Monitored, prometheus: PrometheusServer) -> None:
    shown: dict[str, Any] = {}
    for row in ("Routes", "Route $route"):
        for query in filled(row, instance=monitored.address, route=case):
            shown |= {selector.metric: prometheus.query(query) for selector in selectors(query)}
    [age] = shown["router_route_silence_seconds"]
    assert 0 <= float(age["value"][1]) < 60
    assert float(shown["router_messages_received_total"][0]["value"][1]) > 0
    assert any(float(bucket["value"][1]) > 0 for bucket in shown["router_route_duration_seconds_bucket"])
    targets = {each["metric"]["destination"] for each in shown.get("router_datagrams_sent_total", ())}
    assert targets == set(FLOWS[case].destinations)


def test_a_deadman_that_takes_over_is_an_alert_until_commands_come_again(
    monitored: Monitored, prometheus: PrometheusServer
) -> None:
    def halted() -> set[str]:
        return {labels["route"] for labels in prometheus.firing("DeadmanActive")}

    wait_until(lambda: halted() == set(), "the first commands")
    monitored.traffic.paused.add("manual_drive")
    wait_until(lambda: halted() == {"manual_drive"}, "the alert")
    monitored.traffic.paused.clear()
    wait_until(lambda: halted() == set(), "the end of the alert")


def test_a_serial_line_that_is_unplugged_is_an_alert_until_it_is_plugged_in(
    monitored: Monitored, prometheus: PrometheusServer
) -> None:
    def closed() -> list[str]:
        return [labels["endpoint"] for labels in prometheus.firing("LinkClosed")]

    assert closed() == []
    monitored.drill.pull()
    wait_until(lambda: closed() == ["drill"], "the alert")
    monitored.drill.plug_in()
    wait_until(lambda: closed() == [], "the end of the alert")


def test_a_refused_table_is_an_alert_until_one_is_taken(monitored: Monitored, prometheus: PrometheusServer) -> None:
    assert not prometheus.firing("ReloadFailed")
    sound = monitored.table.read_text()
    monitored.table.write_text(sound + "routes: {imu_info: {source: nobody}}\n")
    assert not monitored.reload()
    wait_until(lambda: bool(prometheus.firing("ReloadFailed")), "the alert")
    monitored.table.write_text(sound)
    assert monitored.reload()
    wait_until(lambda: not prometheus.firing("ReloadFailed"), "the end of the alert")


def test_who_falls_silent_is_an_alert_and_who_never_sent_is_not(
    monitored: Monitored, prometheus: PrometheusServer
) -> None:
    def silent() -> set[str]:
        return {labels["endpoint"] for labels in prometheus.firing("EndpointSilent")}

    wait_until(lambda: silent() == set(), "the first datagrams")
    monitored.traffic.paused |= {case for case, flow in FLOWS.items() if flow.source == "arm_board"}
    wait_until(lambda: silent() == {"arm_board"}, "the alert")
