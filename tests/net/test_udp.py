"""Listeners, senders and the receive thread on real sockets of the loopback interface."""

from __future__ import annotations

import errno
import os
import queue
import resource
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from time import monotonic, sleep

import pytest
from structlog.testing import capture_logs

from router.clock import wall_ns
from router.errors import Located, SourceSpan, StartError
from router.net import receiver, udp
from router.net.kernel import SO_TIMESTAMPNS
from router.net.receiver import FOR_SOCKETS, SAMPLE, Coalescing, ReceiveThread
from router.net.udp import Inherited, Listener, Sender, absence, why_unreachable
from router.table import model
from router.table.addresses import Address, BadAddressError
from router.table.model import EndpointKind, Framing

SPAN = SourceSpan("routes/rover.yaml", 12, 20, 34)
LIMIT = 1000
COALESCE = 1_000_000
Received = "queue.SimpleQueue[tuple[str, bytes, tuple[str, int]]]"


def plan(name: str = "rover", host: str = "127.0.0.1", port: int = 0, receive_buffer: int = 65536) -> model.Listener:
    return model.Listener(name, SPAN, Located(Address(host, port), SPAN), Framing.EXACT, receive_buffer, COALESCE)


def endpoint(name: str, address: Address) -> model.Endpoint:
    return model.Endpoint(name, SPAN, Located(address, SPAN), EndpointKind.TOOL)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def peer(stack: ExitStack) -> socket.socket:
    """A board: bound, and patient for 5 s."""
    board = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    board.bind(("127.0.0.1", 0))
    board.settimeout(5)
    return board


def listen(stack: ExitStack, name: str = "rover") -> Listener:
    return stack.enter_context(closing(Listener(plan(name, receive_buffer=1 << 20))))


@pytest.fixture
def rests(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, float]]:
    """How many datagrams each look of a coalescing listener got, and the rest in seconds that followed."""
    told: list[tuple[int, float]] = []

    class Watched(Coalescing):
        def next(self, taken: int) -> float:
            told.append((taken, super().next(taken)))
            return told[-1][1]

    monkeypatch.setattr(receiver, "Coalescing", Watched)
    return told


def pour(peer: socket.socket, listener: Listener, rate: float, datagrams: int) -> list[bytes]:
    """Sends them one by one, evenly, or faster where this was late."""
    start, sent = monotonic(), [b"%d" % number for number in range(datagrams)]
    for number, data in enumerate(sent):
        sleep(max(0.0, start + number / rate - monotonic()))
        peer.sendto(data, listener.address)
    return sent


class Receiving:
    """A receive thread over some listeners that puts what it gets into a queue."""

    def __init__(self, listeners: list[Listener]) -> None:
        self.got: queue.SimpleQueue[tuple[str, bytes, tuple[str, int]]] = queue.SimpleQueue()
        self.failures: queue.SimpleQueue[Exception] = queue.SimpleQueue()
        receive = {listener.name: self._into_queue(listener.name) for listener in listeners}
        self.thread = ReceiveThread(LIMIT, lambda: FOR_SOCKETS, self.failures.put)
        self.thread.serve(listeners, receive)

    def _into_queue(self, name: str) -> Callable[[bytes, tuple[str, int]], None]:
        def receive(data: bytes, peer: tuple[str, int]) -> None:
            if data == b"bug":
                raise LookupError("a bug")
            self.got.put((name, data, peer))

        return receive

    def all_received(self) -> list[bytes]:
        return [self.got.get_nowait()[1] for _ in range(self.got.qsize())]


@pytest.fixture(params=[1, 3], ids=["one listener", "three listeners"])
def several(request: pytest.FixtureRequest, stack: ExitStack) -> list[Listener]:
    return [listen(stack, f"listener_{number}") for number in range(request.param)]


def test_each_datagram_arrives_with_its_listener_and_peer(several: list[Listener], peer: socket.socket) -> None:
    receiving = Receiving(several)
    receiving.thread.start()
    for listener in several:
        peer.sendto(listener.name.encode(), listener.address)
    arrived = {receiving.got.get(timeout=5) for _ in several}
    receiving.thread.stop()
    assert arrived == {(listener.name, listener.name.encode(), peer.getsockname()) for listener in several}


def test_what_is_called_can_be_replaced_between_two_datagrams(several: list[Listener], peer: socket.socket) -> None:
    receiving = Receiving(several)
    receiving.thread.start()
    peer.sendto(b"old", several[0].address)
    assert receiving.got.get(timeout=5)[1] == b"old"
    new: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    functions = {listener.name: lambda data, _: new.put(data) for listener in several}
    receiving.thread.call_between(lambda: receiving.thread.replace_receivers(functions))
    peer.sendto(b"new", several[0].address)
    assert new.get(timeout=5) == b"new"
    receiving.thread.stop()
    assert receiving.got.empty()


def test_a_task_runs_on_the_thread_and_raises_where_it_was_asked_for(several: list[Listener]) -> None:
    receiving = Receiving(several)
    ran: list[str] = []

    def task() -> None:
        ran.append(threading.current_thread().name)
        raise LookupError("a bug")

    for _ in range(2):
        with pytest.raises(LookupError, match="a bug"):
            receiving.thread.call_between(task)
        receiving.thread.start() if len(ran) == 1 else None
    receiving.thread.stop()
    with pytest.raises(LookupError, match="a bug"):
        receiving.thread.call_between(task)
    assert [name == "receive" for name in ran] == [False, True, False]


def test_turns_go_on_while_nothing_comes(several: list[Listener]) -> None:
    receiving = Receiving(several)
    receiving.thread.start()
    before, deadline = receiving.thread.turns, monotonic() + 5
    while receiving.thread.turns < before + 3:
        assert monotonic() < deadline
        sleep(0.05)
    receiving.thread.stop()
    assert receiving.failures.empty()


def test_a_flood_is_received_whole_and_in_order_and_nobody_else_waits_for_its_end(
    several: list[Listener], peer: socket.socket
) -> None:
    """Thick enough to coalesce. Others get their turn before the flood has been handled."""
    receiving = Receiving(several)
    flood = [b"%d" % number for number in range(40 * SAMPLE)]
    for number, data in enumerate(flood):
        while number - receiving.got.qsize() > 3 * SAMPLE:  # as many fit into any receive buffer
            sleep(0)
        peer.sendto(data, several[0].address)
        if number == SAMPLE:
            receiving.thread.start()
    for listener in several[1:]:
        peer.sendto(b"quiet", listener.address)
    got = [receiving.got.get(timeout=5) for _ in range(len(flood) + len(several) - 1)]
    receiving.thread.stop()
    assert [data for name, data, _ in got if name == several[0].name] == flood
    assert sorted(name for name, data, _ in got if data == b"quiet") == sorted(one.name for one in several[1:])


def test_what_comes_thick_is_looked_at_seldom(
    several: list[Listener], peer: socket.socket, rests: list[tuple[int, float]]
) -> None:
    receiving = Receiving(several)
    receiving.thread.start()
    sent = pour(peer, several[0], 6000, 3000)
    receiving.thread.stop()
    assert receiving.all_received() == sent
    assert max(taken for taken, _ in rests) > 1
    assert 0 < max(rest for _, rest in rests) <= COALESCE / 1e9


def test_a_listener_may_come_when_more_than_a_thousand_descriptors_are_open(
    stack: ExitStack, peer: socket.socket, rests: list[tuple[int, float]]
) -> None:
    """As many clients have them: `select` takes none above 1023."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
    early = listen(stack, "early")
    receiving = Receiving([early])
    receiving.thread.start()
    while stack.enter_context(socket.socket()).fileno() <= 1024:
        continue
    late = listen(stack, "late")
    both = {listener.name: receiving._into_queue(listener.name) for listener in (early, late)}
    receiving.thread.call_between(lambda: receiving.thread.serve([early, late], both))
    sent = pour(peer, late, 6000, 3000)
    receiving.thread.stop()
    assert receiving.failures.empty()
    assert receiving.all_received() == sent
    assert max(taken for taken, _ in rests) > 1


@pytest.mark.parametrize("others", [0, 1])
def test_a_listener_that_never_coalesces_takes_each_at_once(
    stack: ExitStack, peer: socket.socket, rests: list[tuple[int, float]], others: int
) -> None:
    never = Listener(replace(plan(receive_buffer=1 << 20), coalesce=0))
    receiving = Receiving([stack.enter_context(closing(never)), *(listen(stack, "other") for _ in range(others))])
    receiving.thread.start()
    sent = pour(peer, never, 1e9, 10 * SAMPLE)
    receiving.thread.stop()
    assert receiving.all_received() == sent
    assert not rests


def test_after_a_flood_each_datagram_is_waited_for_again(several: list[Listener], peer: socket.socket) -> None:
    receiving = Receiving(several)
    for number in range(4 * SAMPLE):
        peer.sendto(b"%d" % number, several[0].address)
    receiving.thread.start()
    for _ in range(4 * SAMPLE):
        receiving.got.get(timeout=5)
    for number in range(3):
        peer.sendto(b"%d" % number, several[0].address)
        assert receiving.got.get(timeout=5)[1] == b"%d" % number
    receiving.thread.stop()


def test_a_bug_while_datagrams_gather_loses_nothing(several: list[Listener], peer: socket.socket) -> None:
    receiving = Receiving(several)
    sent = [b"bug" if number % 50 == 49 else b"%d" % number for number in range(10 * SAMPLE)]
    for data in sent:
        peer.sendto(data, several[0].address)
    receiving.thread.start()
    receiving.thread.stop()
    assert receiving.all_received() == [data for data in sent if data != b"bug"]
    assert receiving.failures.qsize() == sent.count(b"bug")
    assert isinstance(receiving.failures.get(), LookupError)


def test_nothing_new_gets_in_after_the_end_of_input(stack: ExitStack, peer: socket.socket) -> None:
    listener = listen(stack)
    peer.sendto(b"before", listener.address)
    listener.end_input()
    peer.sendto(b"after", listener.address)
    received = listener.socket.recvfrom(LIMIT)
    assert (received, listener.socket.recvfrom(LIMIT)) == ((b"before", peer.getsockname()), (b"", None))


@pytest.mark.parametrize("host", ["0.0.0.0", "127.255.255.255"], ids=["all interfaces", "a broadcast address"])
def test_a_listener_on_more_than_one_address_ends_too(stack: ExitStack, host: str) -> None:
    listener = stack.enter_context(closing(Listener(plan(host=host))))
    receiving = Receiving([listener])
    receiving.thread.start()
    receiving.thread.stop()
    assert receiving.all_received() == []


class _Stranded(socket.socket):
    """A socket whose address has gone from its interface: the kernel then lets it connect to nothing."""

    def connect(self, address: object) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")


def test_a_listener_whose_address_has_gone_ends_too(stack: ExitStack) -> None:
    listener = listen(stack)
    listener.socket = stack.enter_context(_Stranded(fileno=listener.socket.detach()))
    receiving = Receiving([listener])
    receiving.thread.start()
    receiving.thread.stop()
    assert receiving.all_received() == []


@pytest.mark.parametrize("length", [0, 1, LIMIT, LIMIT + 1, 60000])
def test_a_datagram_arrives_with_its_true_length(several: list[Listener], peer: socket.socket, length: int) -> None:
    receiving = Receiving(several)
    receiving.thread.start()
    sent = bytes(index % 251 for index in range(length))
    peer.sendto(sent, several[0].address)
    _, data, _ = receiving.got.get(timeout=5)
    receiving.thread.stop()
    assert (len(data), data[:LIMIT]) == (length, sent[:LIMIT])


def test_the_kernel_tells_when_each_datagram_arrived_however_long_it_was_left_lying(
    stack: ExitStack, peer: socket.socket
) -> None:
    listener = listen(stack)
    wait_until_the_kernel_stamps(listener, peer)
    sent = []
    for number in range(5):
        before = wall_ns()
        peer.sendto(b"%d" % number, listener.address)
        sent.append((before, wall_ns()))
    told = []
    for _ in sent:
        listener.socket.recv(LIMIT)
        told.append(listener.arrived_at())
    assert all(before <= at <= after for (before, after), at in zip(sent, told, strict=True))


def wait_until_the_kernel_stamps(listener: Listener, peer: socket.socket) -> None:
    """It begins to some time after it was asked to. What it has not stamped counts as arrived when it is looked at."""
    deadline = monotonic() + 5
    while monotonic() < deadline:
        peer.sendto(b"", listener.address)
        sent = wall_ns()
        listener.socket.recv(LIMIT)
        if listener.arrived_at() <= sent:
            return
    raise AssertionError("the kernel stamps nothing")


def test_a_datagram_without_a_stamp_counts_as_just_arrived(stack: ExitStack, peer: socket.socket) -> None:
    listener = listen(stack)
    with pytest.raises(FileNotFoundError):
        listener.arrived_at()
    before = wall_ns()
    peer.sendto(b"first", listener.address)
    listener.socket.recv(LIMIT)
    assert before <= listener.arrived_at() <= wall_ns()


def test_datagrams_that_the_kernel_drops_are_known(stack: ExitStack, peer: socket.socket) -> None:
    listener = stack.enter_context(closing(Listener(plan(receive_buffer=4096))))
    assert listener.kernel_drops() == 0
    for _ in range(500):
        peer.sendto(b"x" * 100, listener.address)
    listener.socket.setblocking(False)
    received = _drain(listener.socket)
    assert listener.kernel_drops() == 500 - received > 0
    listener.close()
    assert listener.kernel_drops() == 500 - received


def _drain(nonblocking: socket.socket) -> int:
    count = 0
    try:
        while nonblocking.recv(LIMIT):
            count += 1
    except BlockingIOError:
        return count
    raise AssertionError("a datagram was empty")


def test_a_port_in_use_is_refused_with_who_has_it(stack: ExitStack) -> None:
    taken = listen(stack).address
    with pytest.raises(StartError) as refused:
        Listener(plan(port=taken.port))
    assert str(refused.value) == (
        f"routes/rover.yaml:12:20: listener 'rover' cannot use {taken}: "
        f"the router itself (pid {os.getpid()}) has the port; restart it, or choose another port"
    )


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        (plan(host="192.0.2.77", port=5000), "no network interface of this computer has that address"),
        (replace(plan(), interface="nowhere0"), "there is no such network interface"),
    ],
)
def test_an_address_or_interface_that_is_not_there_is_waited_for(
    stack: ExitStack, settings: model.Listener, why: str
) -> None:
    listener = stack.enter_context(closing(Listener(settings)))
    assert (listener.is_waiting, listener.lacks_network(), listener.is_replaceable()) == (True, True, False)
    assert listener.bound_to == settings.bound_to
    assert (absence(settings.address.value, settings.interface) or pytest.fail("it is there"))[0] == why
    receiving = Receiving([listener])
    receiving.thread.start()
    receiving.thread.stop()


def test_a_listener_that_is_there_lacks_nothing(stack: ExitStack) -> None:
    listener = listen(stack)
    assert (listener.is_waiting, listener.lacks_network(), listener.is_replaceable()) == (False, False, False)


def test_a_listener_takes_only_what_comes_by_its_interface(stack: ExitStack, peer: socket.socket) -> None:
    listener = stack.enter_context(closing(Listener(replace(plan(host="0.0.0.0"), interface="lo"))))
    peer.sendto(b"hello", ("127.0.0.1", listener.address.port))
    assert listener.socket.recv(100) == b"hello"
    assert listener.bound_to == f"0.0.0.0:{listener.address.port} on lo"
    assert not listener.has_lost_interface()


def test_a_receive_buffer_is_as_large_as_asked_or_warned_about(stack: ExitStack) -> None:
    asked = 8 * int(Path("/proc/sys/net/core/rmem_max").read_text())
    with capture_logs() as logged:
        listener = stack.enter_context(closing(Listener(plan(receive_buffer=asked))))
    granted = listener.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    assert (granted < asked) == any(f"net.core.rmem_max={asked}" in entry.get("remedy", "") for entry in logged)


def send_to(stack: ExitStack, address: Address) -> Sender:
    return stack.enter_context(closing(Sender(endpoint("basestation", address))))


def test_news_of_an_old_loss_does_not_cost_a_healthy_datagram(stack: ExitStack) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as absent:
        absent.bind(("127.0.0.1", 0))
        address = Address(*absent.getsockname())
    sender = send_to(stack, address)
    sender.send(b"lost")  # nobody listens, and the kernel is told so
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(address)
        late.settimeout(5)
        with pytest.raises(ConnectionRefusedError):
            sender.send(b"arrives")
        assert sender.send(b"arrives too") == 11
        assert [late.recv(LIMIT), late.recv(LIMIT)] == [b"arrives", b"arrives too"]


def test_who_looks_hears_of_his_own_loss_and_the_next_datagram_of_none(stack: ExitStack) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        address = Address(*closed.getsockname())
    sender = stack.enter_context(closing(Sender(endpoint("board", address))))
    with pytest.raises(ConnectionRefusedError):
        sender.send_checked(b"brake")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.bind(address)
        board.settimeout(10)
        assert sender.send(b"drive") == 5
        assert sender.send_checked(b"brake") == 5
        assert [board.recv(100) for _ in range(2)] == [b"drive", b"brake"]


def test_losses_are_counted_one_for_one(stack: ExitStack) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as absent:
        absent.bind(("127.0.0.1", 0))
        sender = send_to(stack, Address(*absent.getsockname()))
    outcomes = []
    for _ in range(10):
        try:
            outcomes.append(sender.send(b"lost"))
        except ConnectionRefusedError:
            outcomes.append(0)
    assert outcomes == [4] + 9 * [0]  # the loss of the tenth would be told by an eleventh


def test_a_datagram_too_long_to_send_is_an_error_of_its_own(stack: ExitStack, peer: socket.socket) -> None:
    with pytest.raises(OSError, match="too long"):
        send_to(stack, Address(*peer.getsockname())).send(bytes(70000))


def test_a_broadcast_destination_is_no_machine() -> None:
    with pytest.raises(BadAddressError, match=r"127.255.255.255 is not the address of one machine"):
        why_unreachable(Address("127.255.255.255", 9))


# sockets of a service manager


@pytest.fixture
def held(stack: ExitStack) -> socket.socket:
    """The service manager's."""
    held = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    held.bind(("127.0.0.1", 0))
    return held


def plan_of(held: socket.socket) -> model.Listener:
    return plan(port=held.getsockname()[1])


@pytest.fixture
def listener(held: socket.socket, stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> Listener:
    ours = Inherited([held.dup()])
    monkeypatch.setattr(udp, "inherited", lambda: ours)
    return stack.enter_context(closing(Listener(plan_of(held))))


def test_a_listener_takes_the_socket_that_has_its_address(held: socket.socket, listener: Listener) -> None:
    assert listener.is_inherited
    before = wall_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.sendto(b"hello", held.getsockname())
    assert listener.socket.recvfrom(100)[0] == b"hello"
    assert before <= listener.arrived_at() <= wall_ns()


def test_the_next_one_finds_what_the_last_one_left(held: socket.socket, listener: Listener) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        for word in (b"first", b"second"):
            board.sendto(word, held.getsockname())
    assert listener.socket.recv(100) == b"first"
    listener.end_input()
    listener.close()
    with closing(Listener(plan_of(held))) as successor:
        assert successor.socket.recv(100) == b"second"


def test_its_buffer_is_never_made_smaller(held: socket.socket, listener: Listener) -> None:
    before = held.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    assert before > 2 * 65536
    assert listener.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == before
    listener.follow(replace(plan_of(held), receive_buffer=32768))  # as a reload asks for
    assert held.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == before


def test_a_socket_is_taken_for_its_interface_only(stack: ExitStack) -> None:
    bound = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
    bound.bind(("127.0.0.1", 0))
    address = Address(*bound.getsockname())
    ours = Inherited([bound.dup()])
    assert ours.take(str(address)) is None
    assert ours.take(f"{address} on eth0") is None
    assert ours.unclaimed() == [f"{address} on lo"]
    stack.enter_context(ours.take(f"{address} on lo") or pytest.fail("it is there"))
    assert ours.unclaimed() == []


def test_what_nobody_takes_is_told(held: socket.socket, monkeypatch: pytest.MonkeyPatch, stack: ExitStack) -> None:
    stream = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
    stream.bind(("127.0.0.1", 0))
    address = Address(*held.getsockname())
    ours = Inherited([held.dup(), stream.dup()])
    assert len(ours.unclaimed()) == 2
    stack.enter_context(ours.take(str(address)) or pytest.fail("it is there"))
    [left] = ours.unclaimed()
    assert left.endswith("which is no IPv4 UDP socket")
    assert ours.take(str(address._replace(port=1))) is None
    assert ours.take(f"{address} on lo") is None


def test_what_is_meant_for_another_process_is_left_alone() -> None:
    environment = {"LISTEN_PID": "1", "LISTEN_FDS": "3", "LISTEN_FDNAMES": "a:b:c"}
    assert udp._inherited_descriptors(environment) == []
    assert environment == {}
