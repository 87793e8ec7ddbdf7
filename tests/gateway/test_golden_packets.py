"""Packets as the existing gateway's stand-in sent them, and ours for the same bytes: numbers may have other digits."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from router.gateway.json_codec import UnreadableError, encoder
from router.gateway.json_types import Style, schema_text
from router.gateway.packets import Packet, decompress, pack, unpack
from router.types.model import MessageType
from router.types.ros import MsgFiles, RosbagsDefinitions, RosInterfaces
from tests.compiler.interface_package import MESSAGES, NAME

TIME = 1795276800.25
STAMP = struct.pack("<d", TIME)
GOLDEN: list[dict[str, Any]] = [
    json.loads(line) for line in Path(__file__).with_name("golden").joinpath("packets.jsonl").open(encoding="utf-8")
]
SENT = [golden for golden in GOLDEN if golden["data"] is not None]


@pytest.fixture(scope="module")
def interfaces(tmp_path_factory: pytest.TempPathFactory) -> RosInterfaces:
    share = tmp_path_factory.mktemp("share")
    folder = share / NAME / "msg"
    folder.mkdir(parents=True)
    for name, text in MESSAGES.items():
        folder.joinpath(f"{name}.msg").write_text(text + "\n")
    schemas = Path(__file__).parents[2] / "schemas"
    return RosInterfaces(MsgFiles([share, Path(sys.prefix, "share"), schemas]), RosbagsDefinitions())


def declared(interfaces: RosInterfaces, golden: Mapping[str, Any]) -> MessageType:
    found = interfaces.get(golden["type"])
    assert found is not None
    return found


def packed(golden: Mapping[str, Any], text: bytes) -> str:
    """Ours, after its time stamp."""
    packet = Packet(TIME, False, f"/golden/{golden['case']}", golden["type"], text)
    return pack(packet)[len(STAMP) :].decode()


def parts(packet: str) -> tuple[str, str]:
    """What is in front of the JSON, and the JSON's value, in which the order of keys and -0.0 can be seen."""
    head, brace, rest = packet.partition("{")
    return head, repr(json.loads(brace + rest))


def test_data_packets_are_those_of_the_existing_gateway(interfaces: RosInterfaces) -> None:
    for golden in SENT:
        encode = encoder(declared(interfaces, golden), Style.WRAPPED)
        ours = packed(golden, encode(bytes.fromhex(golden["cdr"])))
        assert parts(ours) == parts(golden["data"]), golden["case"]
        if "." not in golden["data"]:  # without floats all bytes are equal
            assert ours == golden["data"]


def test_nothing_is_written_where_the_existing_gateway_sends_nothing(interfaces: RosInterfaces) -> None:
    unsent = [golden for golden in GOLDEN if golden["data"] is None]
    assert unsent
    for golden in unsent:
        encode = encoder(declared(interfaces, golden), Style.WRAPPED)
        with pytest.raises(UnreadableError):
            encode(bytes.fromhex(golden["cdr"]))


def test_schema_packets_are_those_of_the_existing_gateway(interfaces: RosInterfaces) -> None:
    described = [golden for golden in GOLDEN if "schema" in golden]
    assert described
    for golden in described:
        assert packed(golden, schema_text(declared(interfaces, golden), Style.WRAPPED).encode()) == golden["schema"]


def test_packets_that_the_existing_gateway_compressed_are_read() -> None:
    compressed = [golden for golden in GOLDEN if "compressed" in golden]
    assert compressed
    for golden in compressed:
        packet = unpack(STAMP + bytes.fromhex(golden["compressed"]))
        plain = unpack(STAMP + golden["data"].encode())
        assert packet.is_compressed
        assert not plain.is_compressed
        assert packet._replace(is_compressed=False, payload=decompress(packet.payload, 1 << 20)) == plain
