"""The generated reference pages are up to date, and examples do what the text says."""

from __future__ import annotations

import json
import re
import runpy
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import indent
from typing import IO

import pytest
import yaml

from router.assets import asset
from router.compiler import check_table
from router.gateway.documents import CallRequest, PublishRequest, request
from router.gateway.json_codec import decoder, encoder
from router.gateway.json_types import Style, schema_text
from router.gateway.packets import Packet, compress, pack, unpack
from router.table.schema import table_schema
from router.types.ros import ros_interfaces
from tests.docs_commands import file_name
from tests.gateway.fake_gateway import FakeGateway
from tests.ports import free_port
from tests.repeating import repeating
from tests.tables import ROUTES

DOCS = Path(__file__).parent.parent / "docs"
ROVER = ROUTES / "rover.yaml"
PAGES = runpy.run_path(str(DOCS / "generate.py"))["PAGES"]
PATIENCE = 30.0
PROTOCOL = "reference/gateway-protocol.md"


def examples(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("name", PAGES)
def test_page_is_what_the_code_says(name: str) -> None:
    assert (DOCS / name).read_text(encoding="utf-8") == PAGES[name](), "run `python docs/generate.py`"


@pytest.mark.parametrize(
    ("page", "schema"), [("keys", "schemas/route-table.schema.json"), ("test-keys", "schemas/table-test.schema.json")]
)
def test_every_key_of_a_schema_is_on_its_page(page: str, schema: str) -> None:
    text = (DOCS / f"reference/{page}.md").read_text(encoding="utf-8")
    shown = {line.split("`")[1].rpartition(".")[2] for line in text.splitlines() if line.startswith("| `")}
    assert set(keys(json.loads(asset(schema).read_text(encoding="utf-8")))) - shown == set()


def keys(schema: object) -> Iterator[str]:
    """The keys that a schema declares, without those for whole tables."""
    if not isinstance(schema, dict):
        return
    for name, value in schema.items():
        if name == "properties":
            yield from value
        if name not in ("if", "complete", "complete_route", "complete_gateway"):
            yield from keys(value)


OTHER_YAML = ("guides/test-tables.md",)
"""Pages whose YAML blocks are not tables. tests/test_docs_commands.py writes the blocks that are whole files."""


def table_examples() -> Iterator[str]:
    """The YAML blocks of a page as tables. Some blocks show routes without the key above them."""
    user_pages = (
        str(page.relative_to(DOCS))
        for folder in ("start", "guides", "troubleshooting")
        for page in (DOCS / folder).glob("*.md")
    )
    pages = ["../README.md", "index.md", "reference/table.md", *sorted(user_pages)]
    for example in (text for page in pages if page not in OTHER_YAML for text in examples(page, "yaml")):
        if file_name(example.partition("\n")[0]):
            continue
        bare = not re.match(rf"#|({'|'.join(table_schema()['properties'])}):", example)
        yield "routes:\n" + indent(example, "  ") if bare else example


@pytest.mark.parametrize("example", [*table_examples()])
def test_each_example_of_a_table_is_good_in_place_of_what_the_rover_has(tmp_path: Path, example: str) -> None:
    table = tmp_path / "table.yaml"
    package = "" if "defaults:" in example else "defaults: {package: comms}\n"  # as in the rover's table
    table.write_text(f"extends: {ROVER}\n{package}{example}")
    assert list(map(str, check_table(table).diagnostics)) == []


@pytest.mark.parametrize("page", ["reference/table.md", "guides/gateways.md", "guides/from-cpp.md"])
def test_examples_with_gateways_only_need_nothing_but_the_version(tmp_path: Path, page: str) -> None:
    table = tmp_path / "table.yaml"
    whole = [text for text in examples(page, "yaml") if "\ngateways:" in f"\n{text}"]
    assert whole
    for example in whole:
        version = "" if re.search(r"^version:", example, re.MULTILINE) else "version: 1\n"
        table.write_text(version + example)
        assert list(map(str, check_table(table, {}).diagnostics)) == []


@pytest.mark.parametrize("page", ["guides/gateways.md", "guides/from-cpp.md"])
def test_no_headset_gets_compressed_packets(page: str) -> None:
    """The app of the C++ gateway's project refuses them."""
    tables = [yaml.safe_load(text) for text in examples(page, "yaml") if "\ngateways:" in f"\n{text}"]
    headsets = [gateway for table in tables for name, gateway in table["gateways"].items() if "headset" in name]
    assert headsets
    assert [gateway["compression"] for gateway in headsets if "compression" in gateway] == []


# -- links ---------------------------------------------------------------------------------------------------------

TEXTS = [*DOCS.parent.glob("*.md"), *DOCS.rglob("*.md")]


def anchors(page: Path) -> set[str]:
    """The anchors that code hosts generate for headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        for heading in re.findall(r"^#+ (.*)", text, re.MULTILINE)
    }


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: page.name)
def test_pages_of_the_site_do_not_link_to_files_outside(page: Path) -> None:
    links = re.findall(r"\]\((?!\w+://)([^)\s#]+)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).resolve().is_relative_to(DOCS.resolve())] == []


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_links_to_files_and_headings_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!\w+://)([^)\s#]*)(?:#([^)\s]*))?\)", page.read_text(encoding="utf-8"))
    places = [((page.parent / path).resolve() if path else page, anchor) for path, anchor in links]
    wrong = [place for place in places if not place[0].exists() or (place[1] and place[1] not in anchors(place[0]))]
    assert wrong == []


# -- docs/reference/gateway-protocol.md --------------------------------------------------------------------------------

VECTOR = ros_interfaces().get("geometry_msgs/msg/Vector3")
TIME = 1700000000.25


def vector_packet(**values: float) -> Packet:
    assert VECTOR is not None
    cdr = decoder(VECTOR, Style.PLAIN)(json.dumps(values).encode())
    return Packet(TIME, False, "/imu/rate", VECTOR.name, encoder(VECTOR, Style.WRAPPED)(cdr))


def test_the_packet_that_is_taken_apart_is_one_of_the_gateway() -> None:
    [example] = examples(PROTOCOL, "hex")
    data = bytes.fromhex("".join(line.partition("   ")[0] for line in example.splitlines()))
    assert data == pack(vector_packet(x=1.0, y=0.1, z=-2.5))
    assert f"These {len(data)} bytes" in (DOCS / PROTOCOL).read_text(encoding="utf-8")


def test_schema_and_documents_are_as_they_are_shown() -> None:
    assert VECTOR is not None
    schema, sent, received, call = examples(PROTOCOL, "json")
    assert json.loads(schema) == json.loads(schema_text(VECTOR, Style.WRAPPED))
    data = next(line for line in map(json.loads, sent.splitlines()) if line["op"] == "data")
    cdr = decoder(VECTOR, Style.PLAIN)(json.dumps(data["data"]).encode())
    assert json.loads(encoder(VECTOR, Style.PLAIN)(cdr)) == data["data"]
    published = request(received.splitlines()[0].encode())
    assert isinstance(published, PublishRequest)
    assert published.type_name == "geometry_msgs/msg/Twist"
    twist = ros_interfaces().get(published.type_name)
    assert twist is not None
    assert decoder(twist, Style.PLAIN)(published.data)
    called = request(call.encode())
    assert isinstance(called, CallRequest)
    assert called.type_name == "std_srvs/srv/SetBool"
    assert json.loads(called.data) == {"data": True}


@contextmanager
def program(folder: Path, name: str, *arguments: object) -> Iterator[IO[str]]:
    """Run the example that begins with this file name; yields its output."""
    [text] = (text for text in examples(PROTOCOL, "python") if text.startswith(f"# {name}: python {name} "))
    (folder / name).write_text(text)
    command = [sys.executable, name, *map(str, arguments)]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        try:
            yield running.stdout
        finally:
            running.kill()


def test_the_client_shows_data_whose_schema_it_has(tmp_path: Path) -> None:
    assert VECTOR is not None
    port = free_port()
    plain = vector_packet(x=1.0, y=0.1, z=-2.5)
    schema = plain._replace(payload=schema_text(VECTOR, Style.WRAPPED).encode())
    compressed = plain._replace(is_compressed=True, payload=compress(plain.payload, 3))
    early = plain._replace(topic="/early", type_name="geometry_msgs/msg/Point")
    packets = [pack(packet) for packet in (early, schema, plain, compressed)]
    line = f'{TIME:.3f} /imu/rate {{"x": [1.0], "y": [0.1], "z": [-2.5]}}\n'
    with program(tmp_path, "client.py", "127.0.0.1", port) as printed, sent_again_and_again(packets, port):
        assert [printed.readline() for _ in range(4)] == [line] * 4


@contextmanager
def sent_again_and_again(packets: Sequence[bytes], port: int) -> Iterator[None]:
    """Send again and again, as a gateway does, because the client may not have started."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gateway:

        def send() -> None:
            for packet in packets:
                gateway.sendto(packet, ("127.0.0.1", port))

        with repeating(send, 0.05):
            yield


def test_the_udp_client_that_sends_sends_a_packet_that_the_gateway_reads(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gateway:
        gateway.bind(("127.0.0.1", 0))
        gateway.settimeout(PATIENCE)
        with program(tmp_path, "send.py", *gateway.getsockname()):
            sent = unpack(gateway.recv(65535))
    assert (sent.topic, sent.type_name, sent.is_compressed) == ("/cmd_vel", "geometry_msgs/msg/Twist", False)
    twist = ros_interfaces().get(sent.type_name)
    assert twist is not None
    assert decoder(twist, Style.WRAPPED)(sent.payload)


def test_the_client_that_sends_sends_what_the_simulated_rover_lets_in(tmp_path: Path) -> None:
    table = check_table(ROVER.with_name("sim.yaml"), {})
    [(topic, inbound)] = table.gateways[0].inbound.items()
    gateway = FakeGateway()
    try:
        with program(tmp_path, "drive.py", f"ws://127.0.0.1:{gateway.port}/"):
            sent = gateway.received.get(timeout=PATIENCE)
    finally:
        gateway.close()
    assert (sent["op"], sent["topic"]) == ("publish", topic)
    assert isinstance(sent["time"], float)
    assert decoder(inbound.type, Style.PLAIN)(json.dumps(sent["data"]).encode())
