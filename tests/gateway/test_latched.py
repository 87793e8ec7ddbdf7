"""A latched value with several gateways: real publishers in processes of their own, clients that the test plays."""

from __future__ import annotations

import asyncio
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stage import Played, Stage, program
from tests.ros.opening import STRING, cdr, open_ros
from tests.ros.peers import Publisher

GATEWAY = (
    "{{transport: {{tcp: 127.0.0.1:{port}}}, format: json_lines, publish_period: {period}, "
    "topics: {{include: [/greeting]}}, discovery_period: 50ms}}"
)
PATIENCE_S = 20.0
OUTCOMES = ("messages_sent", "messages_filtered")


def texts(played: Played) -> list[str]:
    return [frame.data.decode().split('"data":{"data":"')[1].split('"')[0] for frame in played.client.values]


def has_come(played: Played, text: str) -> bool:
    return texts(played)[-1:] == [text]


ALIKE = [pytest.param((period, period), marks=pytest.mark.slow) for period in ("20ms", "each")]


@pytest.mark.parametrize("periods", [("20ms", "each"), ("each", "20ms"), *ALIKE])
@pytest.mark.parametrize("kept", [3, pytest.param(1, marks=pytest.mark.slow)])
@asynchronous
async def test_a_latched_value_is_sent_and_counted_once_however_many_gateways_join(
    tmp_path: Path, periods: tuple[str, str], kept: int
) -> None:
    first, second, third = (
        GATEWAY.format(port=8600 + number, period=period) for number, period in enumerate((*periods, periods[0]))
    )
    made = program(tmp_path, f"first: {first}, second: {second}, third: {third}")
    with closing(Publisher("greeting", STRING, "--transient-local")) as peer, closing(open_ros()) as ros:
        peer.publish([cdr(str(number)) for number in range(kept)])
        async with Stage(made, ros.topics) as stage:
            for name, played in stage.played.items():
                await played.start()
                await until(partial(has_come, played, str(kept - 1)))
                await asyncio.sleep(0.3)  # what would come again comes now
                for other in stage.played.values():
                    if hasattr(other, "transport"):
                        assert len(set(texts(other))) == len(texts(other))
                received = stage.count("messages_received", name, "ros")
                assert received <= kept
            before = {name: stage.count("messages_received", name, "ros") for name in stage.played}
            peer.publish([cdr("new")])
            await until(lambda: all(has_come(played, "new") for played in stage.played.values()))
            for name, played in stage.played.items():
                assert len(set(texts(played))) == len(texts(played))
                received = stage.count("messages_received", name, "ros")
                assert received == before[name] + 1 <= kept + 1
                assert received == sum(stage.count(outcome, name, "clients") for outcome in OUTCOMES)
            assert stage.faults == []
