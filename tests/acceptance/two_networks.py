"""A rover with a LAN and a radio, each in a network namespace with real interfaces, and attackers."""

from __future__ import annotations

import socket
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tests.acceptance.payloads import WIRE
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import ROOT, RouterProcess, key, samples_in
from tests.namespaces import Computer, cable, computers

BASESTATION, BOARD = ("10.78.2.10", 9000), ("10.78.1.222", 8)
LAN, RADIO = ("10.78.1.1", 5000), ("10.78.2.1", 5000)
"""The rover's address in each network."""
DRIVE = WIRE.encode(WIRE.case("manual_drive"), WIRE.case("manual_drive").message_class())
BRAKE = WIRE.envelopes.first.message_class(manual_brake={"brake": True}).SerializeToString()


@dataclass
class Rover:
    """The rover and its two networks, with sockets of `board` and `basestation`."""

    folder: Path
    rover: Computer
    lan: Computer
    radio: Computer
    board: socket.socket
    basestation: socket.socket

    def table(self, text: str) -> Path:
        path = self.folder / "table.yaml"
        path.write_text(text.format(root=ROOT))
        return path

    @contextmanager
    def router(self, text: str) -> Iterator[RouterProcess]:
        path = self.table(text)
        with self.rover.inside(lambda: RouterProcess(self.folder, path)) as router:
            yield router

    def samples(self) -> dict[str, float]:
        def ask() -> str:
            with urllib.request.urlopen("http://127.0.0.1:9108/metrics", timeout=PATIENCE) as answer:
                return str(answer.read().decode())

        return samples_in(self.rover.inside(ask))

    def board_gets(self) -> list[bytes]:
        """The unread datagrams at the board, without those of deadmen."""
        found = []
        self.board.settimeout(0.2)
        with suppress(TimeoutError):
            while True:
                found.append(self.board.recv(1000))
        self.board.settimeout(PATIENCE)
        return [datagram for datagram in found if datagram != BRAKE]

    def count(self, metric: str, **labels: str) -> float:
        return self.samples()[key(metric, **labels)]

    def mismatches(self, listener: str) -> float:
        return self.count("datagrams_rejected_total", listener=listener, reason="source_mismatch")

    def seen(self, endpoint: str) -> bool:
        return key("endpoint_silence_seconds", endpoint=endpoint) in self.samples()


def udp(computer: Computer, address: tuple[str, int]) -> socket.socket:
    opened = computer.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    opened.bind(address)
    opened.settimeout(PATIENCE)
    return opened


@contextmanager
def rover_with_networks(folder: Path) -> Iterator[Rover]:
    with computers("rover", "lan", "radio") as (rover, lan, radio), ExitStack() as stack:
        cable(rover, "lan0", "10.78.1.1/24", lan, "eth0", "10.78.1.222/24")
        cable(rover, "radio0", "10.78.2.1/24", radio, "eth0", "10.78.2.10/24")
        lan.ip("address", "add", "10.78.1.60/24", "dev", "eth0")
        board = stack.enter_context(udp(lan, BOARD))
        basestation = stack.enter_context(udp(radio, BASESTATION))
        yield Rover(folder, rover, lan, radio, board, basestation)


def attacker(site: Rover, stack: ExitStack, computer: Computer, address: tuple[str, int]) -> socket.socket:
    """A socket with another host's address, in the network to which that host is not connected."""
    computer.ip("address", "add", f"{address[0]}/32", "dev", "eth0")
    computer.ip("route", "replace", "10.78.0.0/16", "dev", "eth0")
    # Otherwise the router's answers and its ARP would tell the two apart.
    return stack.enter_context(udp(computer, (address[0], 0)))
