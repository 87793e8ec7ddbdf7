"""A gateway in a Zenoh network of this machine: real sessions over TCP on the loopback interface, no multicast."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from typing import NamedTuple

import pytest
import zenoh
from structlog.testing import capture_logs

from router.errors import Located, SourceSpan, StartError
from router.gateway.transport import zenoh as gateway_zenoh
from router.gateway.transport.base import HIGH_WATER, Client, Frame
from router.gateway.transport.zenoh import ZenohTransport
from router.gateway.transport.zenoh_session import session_config
from router.table.model.gateways import ZenohConfig, ZenohSettings
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.transport_events import Events, data, opened
from tests.ports import free_port

KEY = "rovers/loki_1"
MOST = 1 << 20


def settings(mode: str = "peer", connect: tuple[str, ...] = (), listen: tuple[str, ...] = ()) -> ZenohSettings:
    return ZenohSettings(Located(KEY, SourceSpan("routes/rover.yaml")), mode, connect, listen)


def patient(where: str) -> ZenohSettings:
    """Settings with which Zenoh drops nothing that is large because the machine is slow."""
    waits = {"wait_before_drop": 60_000_000, "max_wait_before_drop_fragments": 60_000_000}
    config = {"transport": {"link": {"tx": {"queue": {"congestion_control": {"drop": waits}}}}}}
    given = ZenohConfig(SourceSpan("routes/rover.yaml"), json.dumps(config))
    return replace(settings(listen=(where,)), config=given)


def locator() -> str:
    return f"tcp/127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"


@contextmanager
def session(mode: str, **endpoints: str) -> Iterator[zenoh.Session]:
    """`endpoints` are connect or listen."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, where in endpoints.items():
        config.insert_json5(f"{name}/endpoints", json.dumps([where]))
    with zenoh.open(config) as joined:
        yield joined


class Serving(NamedTuple):
    """A gateway that listens at `where` and owns its key."""

    transport: ZenohTransport
    events: Events
    client: Client
    where: str


@asynccontextmanager
async def serving(most: int = MOST, *, is_patient: bool = False) -> AsyncIterator[Serving]:
    events, where = Events(), locator()
    chosen = patient(where) if is_patient else settings(listen=(where,))
    transport = ZenohTransport(chosen, events, most)
    async with opened(transport):
        await until(lambda: events.clients)
        yield Serving(transport, events, events.clients[0], where)


@asynccontextmanager
async def listening(served: Serving) -> AsyncIterator[list[tuple[str, bytes]]]:
    """What another session hears from now on, as (key, payload)."""
    heard: list[tuple[str, bytes]] = []

    def is_heard() -> bool:
        served.client.write([data(b"are you there", "/hello")])
        return bool(heard)

    with session("client", connect=served.where) as far:
        far.declare_subscriber(
            f"{KEY}/**", lambda sample: heard.append((str(sample.key_expr), sample.payload.to_bytes()))
        )
        await until(is_heard)  # the wish to hear has to arrive first
        served.client.write([data(b"go on", "/hello")])
        await until(lambda: heard[-1][1] == b"go on")
        heard.clear()
        yield heard


@asynccontextmanager
async def sending(served: Serving) -> AsyncIterator[zenoh.Session]:
    """Another session, that the gateway hears."""

    def is_heard() -> bool:
        far.put(f"{KEY}/inbound/hello", b"are you there")
        return bool(served.events.said)

    with session("peer", connect=served.where) as far:
        await until(is_heard)
        far.put(f"{KEY}/inbound/hello", b"go on")
        await until(lambda: served.events.said[-1] == b"go on")
        for told in (served.events.said, served.events.said_by, served.events.refusals):
            told.clear()
        yield far


def schema(type_name: str) -> Frame:
    return Frame(b"a schema", "", type_name, is_schema=True)


@asynchronous
async def test_data_is_found_by_topic_and_schemas_by_type() -> None:
    async with serving() as served:
        client = served.client
        assert client.label == f"zenoh {KEY}"
        async with listening(served) as heard:
            served.transport.write_all([client], [schema("sensor_msgs/msg/Imu"), data(b"one", "/loki_1/imu")])
            client.write([data(b"two", "/loki_1/imu")])
            await until(lambda: len(heard) == 3)
            assert heard == [
                (f"{KEY}/schema/sensor_msgs/msg/Imu", b"a schema"),
                (f"{KEY}/data/loki_1/imu", b"one"),
                (f"{KEY}/data/loki_1/imu", b"two"),
            ]
            await until(lambda: not client.backlog())
    assert served.events.gone == [client]
    assert served.events.failures == []
    client.write([data(b"too late")])
    assert client.backlog() == 0


@asynchronous
async def test_a_document_without_a_topic_is_found_by_its_kind() -> None:
    async with serving() as served, listening(served) as heard:
        served.client.write([data(b"why", "rejected", ""), data(b"a value", "/rejected")])
        await until(lambda: len(heard) == 2)
        assert heard == [(f"{KEY}/rejected", b"why"), (f"{KEY}/data/rejected", b"a value")]


@asynchronous
async def test_what_is_put_under_inbound_is_heard() -> None:
    async with serving(most=100) as served, sending(served) as far:
        far.put(f"{KEY}/inbound/cmd_vel", b"go")
        far.put(f"{KEY}/inbound/cmd_vel", b"x" * 101)
        far.put(f"{KEY}/inbound", b"x" * 100)
        far.delete(f"{KEY}/inbound/cmd_vel")
        far.put(f"{KEY}/data/cmd_vel", b"not for us")
        far.put("rovers/loki_2/inbound/cmd_vel", b"nor this")
        far.put(f"{KEY}/inbound/cmd_vel", b"stop")
        await until(lambda: len(served.events.said) == 3)
        assert served.events.said == [b"go", b"x" * 100, b"stop"]
        assert set(served.events.said_by) == {served.client}
        assert served.events.refusals == ["too_large"]


@asynchronous
async def test_samples_that_come_faster_than_they_are_taken_are_refused_each(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving() as served, sending(served) as far:
        monkeypatch.setattr(gateway_zenoh, "MOST_RECEIVED", 5)
        events = served.events
        for number in range(2000):
            far.put(f"{KEY}/inbound/cmd_vel", str(number), congestion_control=zenoh.CongestionControl.BLOCK)
        await until(lambda: len(events.said) + len(events.refusals) == 2000)
        assert set(events.refusals) <= {"rate_limited"}
        assert events.failures == []
        numbers = list(map(int, events.said))
        assert numbers == sorted(numbers)


@asynchronous
async def test_a_late_joiner_asks_and_gets_schemas_and_latest_values_at_once() -> None:
    async with serving() as served:
        served.events.shown = [schema("std_msgs/msg/Bool"), data(b"true", "/on"), data(b"false", "/off")]
        with session("client", connect=served.where) as far:

            def ask(key: str) -> list[tuple[str, bytes]]:
                return [
                    (str(reply.ok.key_expr), reply.ok.payload.to_bytes())
                    for reply in far.get(key, timeout=10, consolidation=zenoh.ConsolidationMode.NONE)
                    if reply.ok is not None
                ]

            everything = await asyncio.to_thread(ask, f"{KEY}/**")
            assert everything == [
                (f"{KEY}/schema/std_msgs/msg/Bool", b"a schema"),
                (f"{KEY}/data/on", b"true"),
                (f"{KEY}/data/off", b"false"),
            ]
            assert await asyncio.to_thread(ask, f"{KEY}/data/off") == everything[2:]
            assert await asyncio.to_thread(ask, f"{KEY}/data/unknown") == []
            several = await asyncio.gather(*(asyncio.to_thread(ask, f"{KEY}/data/on") for _ in range(20)))
            assert several == [everything[1:2]] * 20
    assert served.events.failures == []


@asynchronous
async def test_a_large_message_arrives_whole_and_small_ones_need_not_wait_for_it() -> None:
    large = b"x" * 7_000_000
    async with serving(is_patient=True) as served, listening(served) as heard:
        served.client.write([schema("Cloud"), data(large, "/cloud"), data(b"small", "/imu")])
        await until(lambda: not served.client.backlog())  # though the large one may still be on its way
        await until(lambda: len(heard) == 3)
        assert heard[0][0] == f"{KEY}/schema/Cloud"
        assert dict(heard)[f"{KEY}/data/cloud"] == large


@asynchronous
async def test_of_large_values_only_the_newest_waits_and_the_others_are_told() -> None:
    async with serving(is_patient=True) as served, listening(served) as heard:
        served.client.write([data(b"%03d" % number + b"x" * 3_000_000, "/cloud") for number in range(20)])
        last = f"{KEY}/data/cloud"
        await until(lambda: any(key == last and value[:3] == b"019" for key, value in heard))
        lost = sum(lost for _, _, lost in served.events.failures)
        assert lost > 0
        assert len(heard) + lost == 20


@asynchronous
async def test_much_that_is_written_at_once_is_put_and_the_client_drains() -> None:
    async with serving() as served:
        served.client.write([data(b"x" * 10_000)] * 100)
        assert served.client.backlog() > HIGH_WATER
        await until(lambda: served.events.eased == [served.client])
        assert served.client.backlog() == 0


@asynchronous
async def test_a_router_that_is_not_there_yet_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_zenoh, "RETRY_SECONDS", 0.02)
    events, where = Events(), locator()
    transport = ZenohTransport(settings("client", connect=(where,)), events, MOST)
    with capture_logs() as logs:
        async with opened(transport):
            await asyncio.sleep(0.1)
            assert events.clients == []
            with session("router", listen=where):
                await until(lambda: events.clients)
                async with listening(Serving(transport, events, events.clients[0], where)):
                    pass
    assert [log["log_level"] for log in logs if log["log_level"] != "debug"] == ["warning", "info"]
    assert "Unable to connect" in logs[0]["why"]
    assert ".rs" not in logs[0]["why"]


@asynchronous
async def test_a_network_that_is_lost_and_found_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_zenoh, "CONNECTIONS_SECONDS", 0.05)
    events, where = Events(), locator()
    with capture_logs() as logs, session("router", listen=where) as hub:
        async with opened(ZenohTransport(settings("client", connect=(where,)), events, MOST)):
            await until(lambda: events.connections == [1])
            hub.close()  # type: ignore[no-untyped-call]
            await until(lambda: events.connections == [1, 0])
            with session("router", listen=where):
                await until(lambda: events.connections == [1, 0, 1])
                assert [log["event"] for log in logs if "the Zenoh network" in log["event"]] == [
                    "connection to the Zenoh network lost; Zenoh is reconnecting",
                    "reconnected to the Zenoh network",
                ]
    assert events.connections == [1, 0, 1, 0]


@asynchronous
async def test_a_port_that_is_taken_is_refused_with_who_has_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        where = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        transport = ZenohTransport(settings(listen=(where,)), Events(), MOST)
        with pytest.raises(StartError, match=rf"{where} cannot be used: .* has the port"):
            await transport.open()


@asynchronous
async def test_a_key_that_is_none_is_refused() -> None:
    bad = Located("rovers//loki?", SourceSpan("routes/rover.yaml"))
    with pytest.raises(StartError, match="rovers//loki"):
        await ZenohTransport(ZenohSettings(bad), Events(), MOST).open()


@pytest.mark.parametrize("where", ["nonsense", "tcp/", "carrier-pigeon/127.0.0.1:7447"])
@asynchronous
async def test_a_locator_that_zenoh_does_not_know_is_refused(where: str) -> None:
    transport = ZenohTransport(settings(connect=(where,)), Events(), MOST)
    with pytest.raises(StartError):
        await transport.open()
    await transport.close()


@pytest.mark.parametrize("enabled", ["true", "false", None])
def test_what_the_config_says_of_scouting_goes_before_what_the_gateway_would(enabled: str | None) -> None:
    text = f'{{"scouting": {{"multicast": {{"enabled": {enabled}}}}}}}' if enabled else "{}"
    given = ZenohConfig(SourceSpan("routes/rover.yaml"), text)
    config = session_config(replace(settings(listen=("tcp/127.0.0.1:7447",)), config=given))
    assert config.get_json("scouting/multicast/enabled") == (enabled or "false")
    assert config.get_json("mode") == '"peer"'
    assert config.get_json("listen/endpoints") == '["tcp/127.0.0.1:7447"]'


@pytest.mark.parametrize("closes", ["true", "false", None])
def test_links_close_when_a_certificate_expires_unless_the_config_says_no(closes: str | None) -> None:
    text = f'{{"transport": {{"link": {{"tls": {{"close_link_on_expiration": {closes}}}}}}}}}' if closes else "{}"
    config = session_config(replace(settings(), config=ZenohConfig(SourceSpan("routes/rover.yaml"), text)))
    assert config.get_json("transport/link/tls/close_link_on_expiration") == (closes or "true")


RULE = {"id": "a", "permission": "allow", "messages": ["put"], "key_exprs": ["**"]}
SUBJECT = {"id": "b", "usernames": ["me"]}
POLICY = {"rules": ["a"], "subjects": ["c"]}
ACCESS = {"enabled": True, "default_permission": "deny", "rules": [RULE], "subjects": [SUBJECT], "policies": [POLICY]}


@pytest.mark.parametrize(
    ("config", "where", "why"),
    [
        (None, "tls/127.0.0.1:0", "Zenoh needs a `config` for this: .*TLS"),
        (
            {"transport": {"link": {"tls": {"listen_private_key": "/nowhere.key"}}}},
            "tls/127.0.0.1:0",
            "rover.yaml:7:9: .*TLS",
        ),
        (
            {"transport": {"auth": {"usrpwd": {"dictionary_file": "/nowhere"}}}},
            "tcp/127.0.0.1:0",
            "rover.yaml:7:9: .*dictionary",
        ),
        ({"access_control": ACCESS}, "tcp/127.0.0.1:0", "rover.yaml:7:9: .*[Ss]ubject"),
    ],
)
@asynchronous
async def test_a_config_that_zenoh_refuses_when_it_opens_is_refused_with_its_line(
    config: object, where: str, why: str
) -> None:
    given = ZenohConfig(SourceSpan("rover.yaml", 7, 9), json.dumps(config)) if config else None
    transport = ZenohTransport(replace(settings(listen=(where,)), config=given), Events(), MOST)
    with pytest.raises(StartError, match=why):
        await transport.open()


@asynchronous
async def test_who_has_no_password_yet_is_tried_again() -> None:
    """Zenoh says no more of a refused password than of a router that is not there."""
    where = locator()
    given = ZenohConfig(SourceSpan("rover.yaml"), "{}")
    events = Events()
    transport = ZenohTransport(replace(settings("client", connect=(where,)), config=given), events, MOST)
    with capture_logs() as logs:
        async with opened(transport):
            assert events.clients == []
    assert [log["log_level"] for log in logs] == ["warning"]
