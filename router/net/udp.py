"""UDP sockets: listeners that own their port and tell what the kernel dropped, senders that lose nothing to old errors.

Knows no envelope, route or counter; what a datagram means is the engine's business.
"""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable
from contextlib import suppress

from router.compiler.program import ListenerPlan, SenderPlan
from router.errors import SourceSpan, StartError
from router.log import logger
from router.net.inherited import inherited
from router.net.kernel import arrivals, ask_for_receive_buffer, bound_interface, drops, receive_buffer
from router.net.port_holder import port_taken
from router.table.model import Address, bound_to

_NETWORK_CHANGED = (errno.EDESTADDRREQ, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.EINVAL)
"""What sending says: there was no network when the router started, there is none now, or this computer has no longer
the address that the socket sends from."""


class Listener:
    """A bound socket. Opening raises StartError, which says where in the table and what to do.

    Where this process was handed one with the listener's address and interface, it is that one. Then what is not taken
    from it waits for the next process, and what the kernel dropped was perhaps dropped before this one began.
    """

    def __init__(self, plan: ListenerPlan, span: SourceSpan) -> None:
        self._plan = plan
        handed = inherited().take(plan.bound_to)
        self.is_inherited = handed is not None
        self.socket = handed or socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if handed is None:
                if plan.interface is not None:
                    self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, plan.interface.encode())
                # Never SO_REUSEADDR or SO_REUSEPORT: with either, a second router would steal the port unnoticed.
                self.socket.bind(plan.address)
            self._want_receive_buffer(plan)
            self.arrived_at = arrivals(self.socket)
        except OSError as error:
            self.socket.close()
            raise StartError(f"{span}: {_why_not_bound(plan, error)}") from error
        self.address = Address(*self.socket.getsockname())
        self._drops_at_close = 0

    @property
    def name(self) -> str:
        return self._plan.name

    @property
    def bound_to(self) -> str:
        return bound_to(self.address, self._plan.interface)

    @property
    def coalesce(self) -> int:
        """The longest rest, in ns."""
        return self._plan.coalesce

    @property
    def interface(self) -> str | None:
        return self._plan.interface

    def has_lost_interface(self) -> bool:
        """Whether its network interface has gone. It receives nothing then, nor by a later one of the same name."""
        return self._plan.interface is not None and bound_interface(self.socket) is None

    def follow(self, plan: ListenerPlan) -> None:
        """Is what another table calls and wants of the same address and interface."""
        if plan.receive_buffer != self._plan.receive_buffer:
            self._want_receive_buffer(plan)
        self._plan = plan

    def kernel_drops(self) -> int:
        """Datagrams that the kernel threw away before anybody received them, since the socket was opened."""
        return self._drops_at_close if self.socket.fileno() < 0 else drops(self.socket)

    def end_input(self) -> None:
        """Lets nothing new in. What has arrived can still be received; after it comes the end, peer None.

        One that was inherited stays as it is, for whoever has it next: its receiver has to let go of it by himself.

        A socket that is connected to itself takes nothing from others, so that a flood cannot keep the
        receiver busy for ever; shutting down then wakes a receiver that waits.
        """
        if self.is_inherited:
            return
        host, port = self.address
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)  # or one that has a broadcast address may not
        # An interface may have lost the address meanwhile: then nothing comes in, and shutting down wakes all the same.
        with suppress(OSError):
            self.socket.connect(("127.0.0.1" if host == "0.0.0.0" else host, port))
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RD)

    def close(self) -> None:
        self._drops_at_close = self.kernel_drops()
        self.socket.close()

    def _want_receive_buffer(self, plan: ListenerPlan) -> None:
        """What was inherited may have a larger one, for what comes while no process listens."""
        if self.is_inherited and receive_buffer(self.socket) >= plan.receive_buffer:
            return
        if (granted := ask_for_receive_buffer(self.socket, plan.receive_buffer)) >= plan.receive_buffer:
            return
        logger.warning(
            "receive buffer is smaller than the table asks for: bursts may be dropped by the kernel",
            listener=plan.name,
            asked=plan.receive_buffer,
            granted=granted,
            remedy=f"sysctl -w net.core.rmem_max={plan.receive_buffer}",
        )


def _why_not_bound(plan: ListenerPlan, error: OSError) -> str:
    what = f"listener '{plan.name}' cannot use {plan.bound_to}"
    if error.errno == errno.ENODEV:
        return f"{what}: there is no such network interface now; `ip link` lists those that there are"
    if error.errno == errno.EPERM:
        return f"{what}: before Linux 5.7 an 'interface' needs a privilege; grant CAP_NET_RAW"
    if error.errno == errno.EADDRINUSE:
        return f"{what}: {port_taken('udp', plan.address.port)}"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{what}: no network interface of this computer has that address; 0.0.0.0 listens on all of them"
    if error.errno == errno.EACCES:
        return f"{what}: ports below 1024 need a privilege; choose a higher port, or grant CAP_NET_BIND_SERVICE"
    return f"{what}: {error.strerror}"


class Sender:
    """A non-blocking socket, connected to one destination. Opening raises StartError.

    A destination that no network leads to yet (the router may start before the link is up) is warned
    about and tried again with every datagram.
    """

    def __init__(self, plan: SenderPlan, span: SourceSpan) -> None:
        self.endpoint = plan.endpoint
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        try:
            self.socket.connect(plan.address)
        except OSError as error:
            if error.errno != errno.ENETUNREACH:
                self.socket.close()
                what = f"cannot send to endpoint '{plan.endpoint}' at {plan.address}"
                raise StartError(f"{span}: {what}: {error.strerror}") from error
            logger.warning("no network leads to this endpoint yet", endpoint=plan.endpoint, address=str(plan.address))
        self.send = _careful_send(self.socket, plan.address)

    def send_and_look(self, data: bytes) -> int:
        """As `send`, but raises also what is known at once of this datagram: nobody listens there, on this computer.

        With `send`, the next datagram would stand for that loss, which may be another sender's.
        """
        sent = self.send(data)
        if error := self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(error, os.strerror(error))
        return sent

    def close(self) -> None:
        self.socket.close()


def _careful_send(connected: socket.socket, address: Address) -> Callable[[bytes], int]:
    """`send(data)` returns the bytes sent, or raises OSError: then exactly one datagram is lost.

    "Connection refused" is news about an earlier datagram, which was taken for sent. The kernel gives it
    instead of sending this one, so this one is sent now, and the error still raised: it stands for the
    loss of the earlier one. So one is counted as lost for one that is, and the counters balance.

    Where the network has changed, a socket of today is made of `connected` first.
    """
    send = connected.send

    def careful_send(data: bytes) -> int:
        try:
            return send(data)
        except ConnectionRefusedError:
            send(data)
            raise
        except OSError as error:
            if error.errno not in _NETWORK_CHANGED:
                raise
            _connect_anew(connected, address)
            return send(data)

    return careful_send


def _connect_anew(connected: socket.socket, address: Address) -> None:
    """As if it were opened now. Connecting alone would keep the local address that it has, which may have gone."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as fresh:
        fresh.setblocking(False)
        fresh.connect(address)
        os.dup2(fresh.fileno(), connected.fileno(), inheritable=False)
