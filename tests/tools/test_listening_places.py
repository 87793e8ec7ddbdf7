from __future__ import annotations

import pytest

from router.errors import UsageError
from router.table.addresses import Address
from router.table.model import GatewayFormat
from router.tools.listening_places import open_source, remote, topic_filter
from tests.ports import free_port


def silent(line: str) -> None:
    raise AssertionError(line)


@pytest.mark.parametrize("form", ["{}", "127.0.0.1:{}", "udp://127.0.0.1:{}", "udp://{}"])
def test_without_a_scheme_or_with_udp_a_local_port_is_opened(form: str) -> None:
    port = free_port()
    source = open_source(form.format(port), None, None, silent)
    host = "127.0.0.1" if "127" in form else "0.0.0.0"
    assert source.place == f"udp {host}:{port}"
    source.close()


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("tcp://127.0.0.1:8600", "tcp 127.0.0.1:8600"),
        ("ws://127.0.0.1:8765", "websocket 127.0.0.1:8765"),
        ("ws://127.0.0.1:8765/", "websocket 127.0.0.1:8765"),
        ("zenoh://rovers/loki_1?listen=tcp/127.0.0.1:0", "zenoh rovers/loki_1"),
    ],
)
def test_a_scheme_chooses_the_transport(text: str, place: str) -> None:
    source = open_source(text, None, None, silent)
    assert source.place == place
    source.close()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("here", "'here' is not .udp://"),
        ("127.0.0.1", "'127.0.0.1' is not .udp://"),
        ("127.0.0.1:70000", "'70000' is not a UDP port"),
        ("192.0.2.1:8502", "listen: cannot bind 192.0.2.1:8502: this machine has no such address"),
        ("tcp://127.0.0.1", "'127.0.0.1' is not HOST:PORT"),
        ("http://127.0.0.1:80", "'http://127.0.0.1:80' is not .udp://"),
        ("zenoh://a?conect=tcp/127.0.0.1:1", "zenoh has no option 'conect'; did you mean 'connect'"),
        ("zenoh://a?mode=pear", "zenoh: "),
        ("zenoh://a//b?listen=tcp/127.0.0.1:0", "zenoh: "),
    ],
)
def test_what_is_no_place_is_refused_with_the_reason(text: str, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        open_source(text, None, None, silent)


def test_options_of_another_transport_are_refused() -> None:
    with pytest.raises(UsageError, match="--format belongs to tcp://"):
        open_source("8502", GatewayFormat.JSON_LINES, None, silent)
    with pytest.raises(UsageError, match="--ask belongs to udp"):
        open_source("tcp://127.0.0.1:8600", None, Address("127.0.0.1", 8500), silent)


def test_a_remote_address_has_host_and_port() -> None:
    assert remote("127.0.0.1:8500") == Address("127.0.0.1", 8500)
    with pytest.raises(UsageError, match="'8500' is not HOST:PORT"):
        remote("8500")


@pytest.mark.parametrize(
    ("glob", "matched", "others"),
    [
        ("/imu", ["/imu"], ["/imu/data", "/a/imu", "imu"]),
        ("/a/*", ["/a/b"], ["/a", "/a/", "/a/b/c"]),
        ("/a/**", ["/a/b", "/a/b/c"], ["/a", "/ab/c"]),
        ("/**/imu", ["/imu", "/a/imu", "/a/b/imu"], ["/imu/a", "/aimu"]),
        ("/*/b", ["/a/b"], ["/b", "/a/a/b"]),
        ("/a*/b?", ["/a/b1", "/ab/b2"], ["/a/b", "/a/b12", "/a/c/b1"]),
        ("/**", ["/a", "/a/b"], [""]),
    ],
)
def test_a_glob_matches_parts_of_names(glob: str, matched: list[str], others: list[str]) -> None:
    wants = topic_filter([glob])
    assert list(filter(wants, matched)) == matched
    assert list(filter(wants, others)) == []


def test_one_of_several_globs_is_enough_and_none_means_all() -> None:
    wants = topic_filter(["/a", "/b/*"])
    assert [wants(topic) for topic in ("/a", "/b/c", "/c", "/b")] == [True, True, False, False]
    assert topic_filter([])("any\nthing")


def test_what_is_no_glob_is_refused() -> None:
    with pytest.raises(UsageError, match=r"--topic: 'imu' does not begin with '/'; .*did you mean '/imu'"):
        topic_filter(["/a", "imu"])
