"""Where messages arrive: the listeners of the router; and whom they come from and go to: the endpoints."""

import enum
from dataclasses import dataclass, field
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.addresses import BROADCAST, ENDPOINT, GROUP, JOINED, LOCAL, Address, IPNetwork
from router.table.keys import SOME, Listed, Named, Range, Shape
from router.table.model.expressions import FieldMap
from router.table.model.serial import SerialLine
from router.table.model.tcp import TcpClient, TcpServer
from router.table.units import DATA_RATE, PATIENCE, SIZE


def bound_to(address: Address, interface: str | None) -> str:
    """Return the local address of a socket as text: `0.0.0.0:5000`, or `0.0.0.0:5000 on wlan0`."""
    return f"{address} on {interface}" if interface else str(address)


class Framing(enum.Enum):
    ZERO_TRIMMED = "zero_trimmed"
    EXACT = "exact"


class EndpointKind(enum.Enum):
    BOARD = "board"
    BASESTATION = "basestation"
    TOOL = "tool"


@dataclass(frozen=True, slots=True)
class Listener:
    """A local UDP address that the router binds.

    `span` is its name in the table. `receive_buffer` is in bytes. Of a serial line and of TCP, the table sets only
    `link`, and the address is a LinkPlace.
    """

    name: str
    span: SourceSpan
    address: Annotated[Located[Address], LOCAL]
    """The local address to bind; 0.0.0.0 is every network of this computer. A listener receives either IPv4 or IPv6
    datagrams: [::] is every network for IPv6.

    Title: Listener address
    Example: 0.0.0.0:5000
    Example: "[::]:5000"
    """
    framing: Framing = Framing.ZERO_TRIMMED
    """zero_trimmed: senders may remove trailing zero bytes or pad with them; the router undoes both before it forwards.
    exact: a datagram is the envelope and nothing else, so a truncated one is never mistaken for a trimmed one.
    """
    receive_buffer: Annotated[int, SIZE] = 4 << 20
    """How much the kernel may hold for this listener while the router is busy. The kernel's own limit
    (net.core.rmem_max) applies.
    """
    interface: Annotated[str | None, Shape("interface")] = None
    """Receive only datagrams that arrive on this network interface. Several listeners may have the same address, each
    on an interface of its own.

    Example: wlan0
    Example: wg0
    """
    groups: Annotated[tuple[Located[str], ...], JOINED, Listed(least=1, unique=True)] = ()
    """Also receive datagrams to these multicast groups, on `interface`; without it, on the interface to which the
    computer's routes send the group. The address must be at 0.0.0.0, or [::] for IPv6 groups; its port is shared with
    other programs.

    Example: [224.5.23.2]
    Example: ["ff02::4:1"]
    """
    link: SerialLine | TcpClient | TcpServer | None = None
    envelope: Located[str] | None = None
    """Which of the table's `envelopes` its datagrams are. Needed if there are several.

    Example: vision
    """

    @property
    def line(self) -> SerialLine | None:
        return self.link if isinstance(self.link, SerialLine) else None

    @property
    def accepts(self) -> bool:
        """Whether it is a TCP server."""
        return isinstance(self.link, TcpServer)

    @property
    def bound_to(self) -> str:
        return bound_to(self.address.value, self.interface)

    @property
    def group_hosts(self) -> tuple[str, ...]:
        return tuple(group.value for group in self.groups)


STALE_AFTER = 5_000_000_000
"""The default of `stale_after`, in ns."""

EPHEMERAL = "ephemeral"
"""The value of `send_from` for a source port chosen by the kernel, instead of a listener's port."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A named UDP address, or the other end of a serial line or TCP connection: a board, a basestation, a tool.

    `span` is its name in the table. It has one of `unicast`, `group` and `broadcast`; the other end of a link has a
    LinkPlace as `unicast`. `bandwidth` is in bytes per second, `stale_after` in ns, None for never. `send_from`
    is a listener's name, EPHEMERAL, or None if it is not set.
    """

    name: str
    span: SourceSpan
    unicast: Annotated[Located[Address] | None, ENDPOINT, Named("address")] = None
    """Where datagrams to it are sent. Datagrams from it are recognised by the IP address. The running router resolves
    a host name, again and again. learned: the address and port of the first sender of a message for a route with this
    source, until that sender has been silent for longer than `stale_after`. The other end of a serial line or of
    `connect` has none; a client of `accept` has an IP address without a port.

    Title: Endpoint address
    Example: 192.168.0.30:8
    Example: "[fd00::30]:8"
    Example: robot3.local:50052
    Example: learned
    """
    networks: Annotated[tuple[IPNetwork, ...], SOME] = ()
    """Learn the address only in these networks. Default: the `networks` of the table, or else any.

    Title: Networks to learn in
    Example: [192.168.0.0/24]
    """
    because: Annotated[str | None, Shape("reason")] = None
    """Why the address of a board may be learned: any computer that can send to the listener may then get its commands,
    also those that brake.

    Example: the cable leads to nothing but the board, which has DHCP
    """
    group: Annotated[Located[Address] | None, GROUP] = None
    """In place of `address`: the multicast group and port that datagrams are sent to. It is no sender, and no board.

    Title: Multicast group
    Example: 224.5.23.2:10010
    """
    interface: Annotated[str | None, Shape("interface")] = None
    """Send to the group on this network interface. Default: that of the route to the group.

    Example: eth0
    """
    hops: Annotated[int | None, Range(1, 255)] = None
    """How many networks datagrams to the group may pass, the first one included. Default: 1, so they reach no other
    network.

    Example: 1
    """
    broadcast: Annotated[Located[Address] | None, BROADCAST] = None
    """In place of `address`: the broadcast address of a network, and the port. It is no sender, and no board.

    Title: Broadcast address
    Example: 192.168.0.255:4444
    """
    kind: EndpointKind = field(kw_only=True)
    """board: a microcontroller that decodes into fixed-size structures, so datagrams for it are checked against their
    limits. basestation or tool: an ordinary computer.

    Example: board
    """
    listener: Located[str] | None = None
    """Accept its datagrams only at this listener; at any other, a datagram from its address counts as a stranger's. Or
    the serial line or TCP listener that it is at the other end of. Default: accept them at every listener.

    Example: radio
    """
    send_from: Located[str] | None = None
    """Send datagrams to it from this listener's address and port, so that replies reach that listener. ephemeral: from
    a port that the kernel chooses, so replies are lost. Default: the endpoint's listener; without one, the address and
    port of all listeners of its kind of IP address if they are the same, else ephemeral. IPv6 groups: always ephemeral.

    Example: rover
    Example: ephemeral
    """
    source_port: Annotated[Located[int] | None, Range(1, 65_535)] = None
    """The UDP port that it sends from. Needed to distinguish endpoints that share an IP address.

    Example: 9000
    """
    stale_after: Annotated[int | None, PATIENCE] = STALE_AFTER
    """An endpoint that has been silent for longer counts as stale in diagnostics, on the status page, for 'router
    doctor' and in alerts. never: for an endpoint that only sends now and then.

    Example: 5s
    Example: never
    """
    bandwidth: Annotated[int | None, DATA_RATE] = None
    """The most bytes per second to send to it: the capacity of the radio link. When it is used up, commands go first,
    then telemetry, then bulk, and the oldest bulk is dropped. It counts the bytes of router_sent_bytes_total: UDP and
    IP add 28 to each datagram, the link more. Default: no limit.

    Example: 500kB/s
    """
    trim_trailing_zeros: bool = False
    """Send envelopes to it without their trailing zero bytes, for a receiver that restores them."""
    allow_non_finite: bool = False
    """Send a board datagrams with NaN or infinity, because its firmware handles them. Default: drop them as non_finite.
    Only for kind: board; other endpoints always get them.

    Title: Allow NaN and infinity
    """
    beside: Annotated[FieldMap | None, Named("set"), Shape("beside")] = None
    """Fields of the envelope beside the payload, in every message that the router makes for the endpoint: from ROS, and
    for deadman timers. Each is a constant, `sequence`, which counts these messages from 1, or `now`, the time of
    sending, which as a number is in seconds, as in `now * 1000`. Forwarded messages keep their own.

    Example: {seq: sequence, sent_at: now, robot: 3}
    """
    envelope: Located[str] | None = None
    """Which of the table's `envelopes` it gets. Needed if there are several and something is sent to it.

    Example: command
    """

    @property
    def address(self) -> Located[Address]:
        """Where datagrams to it are sent."""
        address = self.unicast or self.group or self.broadcast
        assert address is not None  # noqa: S101 - the schema requires one
        return address

    @property
    def is_one_machine(self) -> bool:
        return self.unicast is not None
