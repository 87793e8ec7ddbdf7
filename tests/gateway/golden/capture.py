"""Captures what the existing gateway's stand-in makes of many messages, and writes packets.jsonl beside this file.

    make setup && .venv/bin/python -m tests.gateway.golden.capture

Takes some minutes, g++, nlohmann-json3-dev and libzstd-dev: it builds benchmarks/peer/gateway_peer.cpp and, with C++,
the nasty messages of tests/compiler/interface_package.py and the rover's of schemas/comms. Each case of cases.py is
published on a topic of its own; the packets come by UDP. The file has one line for each case:

    case        its name; the topic is /golden/CASE
    type        pkg/msg/Type
    cdr         the published bytes, as hexadecimal digits
    data        the data packet after its time stamp, as text: flag 0, topic, NUL, type, NUL, JSON.
                null: nothing is sent for these bytes
    schema      the schema packet in the same way; only with the first case of a type that has one
    compressed  the data packet with `compression_level` 3 after its time stamp, as hexadecimal digits; only if short

Captured again, only the padding within `cdr` differs: rclpy leaves there what was in memory before.

Knows nothing of the router.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.compiler.interface_package import write_sources

ROOT = Path(__file__).parents[3]
GOLDEN = Path(__file__).with_name("packets.jsonl")
PREFIX = "/golden/"
BATCH = 40
"""Topics at a time."""

PATIENCE = 60
"""Seconds for all packets of a batch."""

QUIET = 2
"""Seconds without anything new after which the missing packets are none."""

STAMP = 8
"""Bytes of the packet's time stamp."""

SHORT = 400
"""Bytes up to which a compressed packet is kept."""


def environment(*installs: Path) -> dict[str, str]:
    """What a ROS set-up script would set."""
    prefixes = [*installs, Path(sys.prefix)]
    packages = f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    added = {
        "AMENT_PREFIX_PATH": prefixes,
        "CMAKE_PREFIX_PATH": prefixes,
        "LD_LIBRARY_PATH": [*(prefix / "lib" for prefix in prefixes), *Path(sys.prefix, packages).glob("ros_*.libs")],
        "PYTHONPATH": [ROOT, *(install / packages for install in installs)],
    }
    return os.environ | {
        name: os.pathsep.join([*map(str, paths), os.environ.get(name, "")]).rstrip(os.pathsep)
        for name, paths in added.items()
    }


def build_interfaces(folder: Path) -> Path:
    """The nasty messages and those of the rover, with their C++; where they are installed."""
    write_sources(folder / "nasty")
    install = folder / "install"
    options = [f"-DCMAKE_INSTALL_PREFIX={install}", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={sys.executable}"]
    for source in (folder / "nasty", ROOT / "schemas" / "comms"):
        build = folder / "build" / source.name
        for command in (
            ["cmake", "-S", source, "-B", build, *options],
            ["cmake", "--build", build, "--parallel", "2"],
            ["cmake", "--install", build],
        ):
            subprocess.run([*map(str, command)], env=environment(), stdout=subprocess.DEVNULL, check=True)
    return install


class Stand:
    """The stand-in for one batch, and what came from it: by topic, data and schema packets without their stamps."""

    def __init__(self, peer: Path, topics: Sequence[str], level: int) -> None:
        self.data: dict[str, bytes] = {}
        self.schemas: dict[str, bytes] = {}
        self.newest = time.monotonic()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        to = f"127.0.0.1:{self._socket.getsockname()[1]}"
        periods = ["--refresh-ms", "300", "--publish-ms", "200", "--schema-ms", "500"]
        words = [peer, "--to", to, "--topics", ",".join(topics), *periods, "--compression", level]
        words += ["--log-level", "error"]
        self._process = subprocess.Popen([*map(str, words)], env=environment_of_peer())

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()
        self._socket.close()

    def receive(self) -> None:
        """Whatever is there."""
        try:
            while True:
                packet = self._socket.recv(65535)[STAMP:]
                topic, _, payload = packet[1:].split(b"\0", 2)
                is_schema = payload.startswith(b'{"fields":') and b'"namespace":' in payload
                kept = self.schemas if is_schema else self.data
                if topic.decode() not in kept:
                    kept[topic.decode()] = packet
                    self.newest = time.monotonic()
        except TimeoutError:
            if self._process.poll() is not None:
                raise RuntimeError("the stand-in ended") from None


def environment_of_peer() -> dict[str, str]:
    """Its log is of no interest."""
    return os.environ | {"RCUTILS_LOGGING_USE_STDOUT": "0", "ROS_LOG_DIR": tempfile.gettempdir()}


def captured(peer: Path, cases: Sequence[Any], level: int) -> Stand:
    """What the stand-in sends for a batch of cases."""
    import rclpy
    from rclpy.qos import QoSProfile

    from tests.compiler.ros_objects import message_class

    topics = {PREFIX + case.name: case for case in cases}
    node = rclpy.create_node("capture")
    publishers = {
        topic: node.create_publisher(message_class(case.type_name), topic, QoSProfile(depth=1))
        for topic, case in topics.items()
    }
    stand = Stand(peer, [*topics], level)
    deadline = time.monotonic() + PATIENCE
    while any(not publisher.get_subscription_count() for publisher in publishers.values()):
        stand.newest = time.monotonic()
        if stand.newest > deadline:
            raise RuntimeError("the stand-in subscribes to nothing")
        time.sleep(0.1)
    while len(stand.data) < len(topics) or len(stand.schemas) < len(topics):
        for topic, publisher in publishers.items():
            if topic not in stand.data:
                publisher.publish(topics[topic].cdr)
        stand.receive()
        if time.monotonic() > min(deadline, stand.newest + QUIET):
            break
    stand.close()
    node.destroy_node()
    return stand


def lines(cases: Sequence[Any], peer: Path) -> Iterator[Mapping[str, Any]]:
    """Those of a batch."""
    plain, short = captured(peer, cases, 0), captured(peer, cases, 3)
    for case in cases:
        topic = PREFIX + case.name
        data, schema, compressed = (found.get(topic) for found in (plain.data, plain.schemas, short.data))
        if (data is None) != (compressed is None) or (data is None) != (schema is None):
            raise RuntimeError(f"packets of {case.name} were lost")
        line = {"case": case.name, "type": case.type_name, "cdr": case.cdr.hex(), "data": data and data.decode()}
        line |= {"schema": schema.decode()} if schema else {}
        yield line | ({"compressed": compressed.hex()} if compressed and len(compressed) <= SHORT else {})


def write(peer: Path) -> None:
    """The file of all cases."""
    import rclpy

    from tests.gateway.golden.cases import chosen, of_every_type

    cases = [*chosen(), *of_every_type()]
    rclpy.init(args=[])
    described: set[str] = set()
    with GOLDEN.open("w", encoding="utf-8") as file:
        for first in range(0, len(cases), BATCH):
            for line in lines(cases[first : first + BATCH], peer):
                kept = {
                    name: value for name, value in line.items() if name != "schema" or line["type"] not in described
                }
                described |= {line["type"]} if "schema" in kept else set()
                file.write(json.dumps(kept) + "\n")
            print(f"{min(first + BATCH, len(cases))} of {len(cases)}", file=sys.stderr)
    rclpy.shutdown()


def main() -> None:
    if sys.argv[1:]:
        write(Path(sys.argv[1]))
        return
    from benchmarks.versus.building import PROGRAMS, build

    build()
    peer = PROGRAMS / "gateway_peer"
    if not peer.exists():
        sys.exit("the stand-in cannot be built here: see benchmarks/peer/build.sh")
    folder = Path(tempfile.mkdtemp())
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    try:
        # The loader reads its search path when a process begins.
        words = [sys.executable, "-m", __spec__.name, str(peer)]
        subprocess.run(words, env=environment(build_interfaces(folder)), check=True)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
