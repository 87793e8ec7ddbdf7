"""What is open for the running program, and how another program takes over: prepare, swap, finish, or abandon.

Knows the order in which things belong, and no table that is not compiled.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from router.app.sockets import SocketChange, Sockets
from router.app.topics import open_ros, places, wants_ros, who_names
from router.app.wiring import Surroundings, Wiring, begin, wire
from router.compiler.program import Program
from router.engine import MAX_DATAGRAM
from router.engine.binding import State
from router.engine.dispatch import Receive
from router.log import logger
from router.net.receiver import FOR_SOCKETS, FOR_SUBSCRIBERS, ReceiveThread
from router.ros.environment import check_environment
from router.threads import background_threads

if TYPE_CHECKING:
    from router.gateway.thread import GatewayChange, GatewayThread
    from router.ros.change import RosChange
    from router.ros.node_and_publishers import RosEdge


@dataclass(frozen=True, slots=True)
class Change:
    """A program with all that was opened for it, beside what is open. `undo` closes that."""

    sockets: SocketChange
    topics: RosChange | None
    wiring: Wiring
    gateways: GatewayChange | None
    undo: ExitStack


class Edges:
    """`tee` may put something between a listener and what its datagrams are given to."""

    def __init__(self, around: Surroundings, ros_args: Sequence[str], tee: Callable[[str, Receive], Receive]) -> None:
        self.wiring: Wiring | None = None
        self.sockets = Sockets(around.accounts.drops)
        self.gateways: GatewayThread | None = None
        self._around = around
        self._ros_args = ros_args
        self._tee = tee
        self._ros: RosEdge | None = None
        self._receiving = ReceiveThread([], {}, MAX_DATAGRAM, self._enough, around.reporter.failed)

    @property
    def turns(self) -> int:
        """Grows while the receive thread is not stuck, even if nothing comes."""
        return self._receiving.turns

    @property
    def node_name(self) -> str:
        """As ROS knows it, with its namespace; empty where no table needed a node."""
        return self._ros.name if self._ros else ""

    # -- from the start to the end -------------------------------------------------------------------------------

    def start(self, change: Change, closing: ExitStack) -> None:
        """Serves what was prepared. `closing` ends it: what receives first, and a deadman has the last word."""
        keepers = self._around.keepers
        keepers.start()
        closing.callback(self._stop_ros)
        self._swap(change)
        with background_threads():
            self._finish(change, None)
        self._receiving.start(self._give)  # somebody may have begun to watch during the swap
        closing.callback(self._receiving.stop)

    def close_with(self, closing: ExitStack) -> None:
        """Has `closing` close what is open then: what the router's surroundings need is closed after them."""
        closing.callback(self.sockets.close_listeners)
        closing.callback(self.sockets.close_senders)
        closing.callback(self._close_ros)

    def end_with(self, closing: ExitStack) -> None:
        """Has `closing` end what sends by itself: gateways, open frames, what waits, and deadmen last."""
        keepers = self._around.keepers
        for keeper in (keepers.deadman, keepers.inbound_deadman, keepers.pacing, keepers.collecting):
            closing.callback(keeper.stop)
        closing.callback(self._stop_gateways)

    def rewire(self) -> None:
        """Asks `tee` again."""
        self._receiving.call_between(self._give)

    # -- another program -----------------------------------------------------------------------------------------

    def prepare(self, program: Program) -> Change:
        """Opens what `program` wants and is not open, and changes nothing. Raises StartError.

        For the first program, deadmen send here what they send at the start: nothing is received yet, but gateways hear
        clients as soon as they are open.
        """
        with ExitStack() as undo:
            if self._ros is None and wants_ros(program):
                check_environment(os.environ)  # before a deadman sends for a start that comes to nothing
            sockets = self.sockets.prepare(program)
            undo.callback(sockets.opened.close)
            self._around.accounts.make_room(program.counters)
            state = State(self.wiring.state if self.wiring else None)
            if self.wiring is None:
                begin(program, self._around, sockets, state)
            topics = self._prepare_topics(program, undo)
            undo.callback(lambda: self._around.keepers.release(list(state.added())))
            wiring = wire(program, self._around, sockets, self._ros, topics, state)
            if self.wiring is None:
                wiring.begin(self._around.keepers)
            gateways = self._prepare_gateways(program, wiring, undo)
            return Change(sockets, topics, wiring, gateways, undo.pop_all())

    def take_over(self, change: Change) -> None:
        """Has the prepared program run, from one message to the next.

        Raises StuckError or StartError, and then nothing changed. What fails after that is a fault of ours, and logged.
        """
        earlier = self.wiring
        try:
            if self.gateways is not None and change.gateways is not None:
                self.gateways.retire(change.gateways)
            self._receiving.call_between(lambda: self._swap(change))
        except BaseException:
            change.undo.close()
            raise
        try:
            self._finish(change, earlier)
        except Exception as error:  # noqa: BLE001 told loudly: the program runs all the same
            logger.critical(
                "a fault in the router itself kept it from closing what it does not use; please report it",
                exc_info=error,
            )

    def _swap(self, change: Change) -> None:
        """While nothing is received: on the receive thread, and with that of ROS standing still."""
        with self._ros.paused() if self._ros else nullcontext():
            if self._ros is not None and change.topics is not None:
                self._ros.apply(change.topics, change.wiring.take)  # first: it may still fail
            for listener in self.sockets.left(change.sockets):
                self._receiving.finish(listener)
            change.wiring.succeed(self.wiring, self._around.keepers)
            self.wiring = change.wiring
            self.sockets.apply(change.sockets)
            self._receiving.serve(list(self.sockets.listeners.values()), self._teed())

    def _finish(self, change: Change, earlier: Wiring | None) -> None:
        """Closes what only the earlier program used: all that, whatever one step raises."""
        change.undo.pop_all()  # and not done
        with ExitStack() as last_first:
            if earlier is not None:
                last_first.callback(earlier.forget)
            last_first.callback(self._around.accounts.settle, change.wiring.program.counters)
            last_first.callback(change.sockets.left.close)
            if self._ros is not None and change.topics is not None:
                last_first.callback(self._ros.finish, change.topics)
            last_first.callback(change.wiring.state.forget_previous)
            if self.gateways is not None and change.gateways is not None:
                last_first.callback(self.gateways.finish, change.gateways)
                last_first.callback(self._follow_drops, self.gateways, change.gateways)

    # -- parts ---------------------------------------------------------------------------------------------------

    def _prepare_topics(self, program: Program, undo: ExitStack) -> RosChange | None:
        if self._ros is None and not wants_ros(program):
            return None
        if self._ros is None:
            self._ros = open_ros(program, self._ros_args, self._incompatible, self._met)
            undo.callback(self._close_ros)
            self._ros.start({}, self._around.reporter.failed)
        change = self._ros.prepare(program.publishers, program.subscriptions, places(program))
        undo.callback(self._ros.abandon, change)
        return change

    def _prepare_gateways(self, program: Program, wiring: Wiring, undo: ExitStack) -> GatewayChange | None:
        """A new thread of theirs serves nobody before it is started."""
        if self._ros is None or not (program.gateways or self.gateways):
            return None
        if self.gateways is None:
            from router.gateway.thread import GatewayThread  # asyncio and websockets take 0.1 s to import

            reporter = self._around.reporter
            self.gateways = GatewayThread(self._ros, self._around.accounts.gateways, reporter.report, reporter.failed)
            undo.callback(self._stop_gateways)
        change = self.gateways.prepare(program, wiring.feed)
        undo.callback(self.gateways.abandon, change)
        return change

    def _follow_drops(self, gateways: GatewayThread, change: GatewayChange) -> None:
        drops = self._around.accounts.drops
        for service in change.left:
            drops.leave(service.name)
        for service in change.opened:
            if service.name in gateways.kernel_drops:
                drops.follow(service.name, gateways.kernel_drops[service.name])

    def _incompatible(self, topic: str, policy: str, peers: int) -> None:
        """So many peers on a topic were kept away by one policy: counted for each route that names the topic."""
        if self.wiring is None:
            return
        program = self.wiring.program
        for name in who_names(program).get(topic, ()):
            self._around.accounts.events[program.counters.index("qos_incompatible", name, topic, policy)] = peers

    def _met(self, topic: str) -> None:
        """Somebody new subscribes to a topic of ours."""
        if self.wiring is not None:
            self.wiring.meet(topic, self._around.keepers)

    def _enough(self) -> int:
        return FOR_SUBSCRIBERS if self._ros is not None and self._ros.subscribed else FOR_SOCKETS

    def _give(self) -> None:
        self._receiving.replace_receivers(self._teed())

    def _teed(self) -> dict[str, Receive]:
        receive = self.wiring.receive if self.wiring else {}
        return {name: self._tee(name, each) for name, each in receive.items()}

    def _stop_gateways(self) -> None:
        if self.gateways is not None:
            self.gateways.stop()
            self.gateways = None

    def _stop_ros(self) -> None:
        if self._ros is not None:
            self._ros.stop_receiving()

    def _close_ros(self) -> None:
        if self._ros is not None:
            self._ros.close()
            self._ros = None
