"""The datapath in Python: a receive thread that calls the generated handlers, for everything."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from router.app.sockets import SocketChange
from router.app.wiring import (
    RouterContext,
    Send,
    States,
    Wiring,
    engine_context,
    gateway_deadmen,
    log_start,
    open_pacers,
    python_deadman,
)
from router.clock import boottime_ns
from router.compiler.program import DeadmanPlan, Program
from router.engine import InboundEngine, OutboundEngine
from router.engine.binding import State
from router.engine.deadman import Deadman, commander, feeder
from router.engine.dispatch import Receive
from router.engine.freshness import Freshness
from router.net.receiver import FOR_SOCKETS, FOR_SUBSCRIBERS, ReceiveThread
from router.net.udp import Listener, Sender
from router.recording.mirror import Classifier, Mirror
from router.table import model
from router.types.framing import MAX_DATAGRAM

if TYPE_CHECKING:
    from router.ros.endpoints import RosChange
    from router.ros.router_node import RouterNode

_ALL = "all"
"""The one user of what a program keeps: everything changes to another program at once."""


@dataclass(frozen=True, slots=True)
class PythonWiring(Wiring):
    """`receive` is by listener, `deadmen` are those of routes."""

    receive: Mapping[str, Receive]
    deadmen: Mapping[str, Deadman]


class PythonDatapath:
    """See `Datapath`. `subscribed()` is whether a topic has subscribers."""

    def __init__(self, context: RouterContext, mirror: Mirror, subscribed: Callable[[], bool]) -> None:
        self._context = context
        self._mirror = mirror
        self._wiring: PythonWiring | None = None
        self._receiving = ReceiveThread(
            MAX_DATAGRAM, lambda: FOR_SUBSCRIBERS if subscribed() else FOR_SOCKETS, context.reporter.failed
        )

    @property
    def turns(self) -> int:
        return self._receiving.turns

    def stalled(self) -> None:
        return None

    def open_listener(self, settings: model.Listener, has_senders: bool) -> Listener:
        return Listener(settings, has_senders=has_senders)

    def open_sender(self, endpoint: model.Endpoint, source: Listener | None, listeners: Sequence[Listener]) -> Sender:
        return Sender(endpoint, source, listeners)

    def states(self, earlier: Wiring | None) -> States:
        return States([_ALL], earlier.states if earlier else None)

    def start_deadmen(self, program: Program, sockets: SocketChange, states: States) -> None:
        locked = self._context.timers.deadman.locked
        for plan in program.deadmen:
            deadman = self._deadman(plan, program, sockets, states[_ALL])
            log_start(plan.route, locked(deadman, deadman.start)(boottime_ns()))

    def wire(
        self,
        program: Program,
        sockets: SocketChange,
        ros: RouterNode | None,
        topics: RosChange | None,
        states: States,
    ) -> PythonWiring:
        counts, timers, state = self._context.counts, self._context.timers, states[_ALL]
        send: dict[str, Send] = {endpoint: sender.send for endpoint, sender in sockets.senders.items()}
        deadmen = {plan.route: self._deadman(plan, program, sockets, state) for plan in program.deadmen}
        behind_gateways = gateway_deadmen(program, self._context, ros, state)
        pacers = open_pacers(program, timers.pacing, send, state)
        command = commander(send, deadmen, timers.deadman.locked, boottime_ns)
        errors = ros.publish_errors if ros else ()
        context = replace(engine_context(program, self._context, topics, errors, send, command, pacers), state=state)
        arrived_at = {name: each.arrived_at for name, each in sockets.listeners.items()}
        inbound = InboundEngine(program, context, arrived_at, self._receiving.freshness)
        outbound = OutboundEngine(program, replace(context, counts=counts.ros), ros.freshness if ros else Freshness())
        return PythonWiring(
            program=program,
            take={plan.label: outbound.taker(plan.label) for plan in program.subscriptions},
            feed=feeder(behind_gateways, timers.inbound_deadman.locked),
            states=states,
            gateway_deadmen=behind_gateways,
            pacers=pacers,
            engines=(inbound, outbound),
            receive={name: inbound.receiver(name) for name in sockets.listeners},
            deadmen=deadmen,
        )

    def _deadman(self, plan: DeadmanPlan, program: Program, sockets: SocketChange, state: State) -> Deadman:
        send = {endpoint: sender.send_checked for endpoint, sender in sockets.senders.items()}
        return python_deadman(plan, program, self._context, self._context.counts.deadman, send, state)

    def abandon(self, wiring: Wiring) -> None:
        """There is nothing but timers, which the caller releases."""

    def between(self, wiring: Wiring, swap: Callable[[], None]) -> None:
        self._receiving.call_between(swap)

    def adopt(self, wiring: Wiring, earlier: Wiring | None, left: Sequence[Listener], now: Sequence[Listener]) -> None:
        assert isinstance(wiring, PythonWiring)  # noqa: S101 - made by `wire`
        timers = self._context.timers
        for listener in left:
            self._receiving.finish(listener)
        if isinstance(earlier, PythonWiring):
            for route, deadman in wiring.deadmen.items():
                before = earlier.deadmen.get(route)
                if before is not None and before is not deadman:
                    timers.deadman.locked(deadman, deadman.replace)(before)
        wiring.succeed_gateways(earlier, timers)
        timers.release(list(wiring.states[_ALL].left()))
        wiring.settle_pacers(timers)
        self._wiring = wiring
        self._receiving.serve(now, self._observed())

    def start(self) -> None:
        self._receiving.start(self._replace_receivers)  # an observer may have attached since `adopt`

    def has_passed(self, wiring: Wiring) -> bool:
        return True

    def observe(self, *, is_observed: bool) -> None:
        self._receiving.call_between(self._replace_receivers)

    def watch(self, notify: int, interval: int) -> bool:
        return False

    def stop(self, listeners: Sequence[Listener]) -> None:
        self._receiving.stop()

    def close(self) -> None:
        """Deadmen have ended with the other timers."""

    def _replace_receivers(self) -> None:
        self._receiving.replace_receivers(self._observed())

    def _observed(self) -> dict[str, Receive]:
        if self._wiring is None:
            return {}
        program = self._wiring.program
        known = Classifier(program.envelope, program.table)
        return {
            name: self._mirror.tee(name, each, partial(known.sender, name))
            for name, each in self._wiring.receive.items()
        }
