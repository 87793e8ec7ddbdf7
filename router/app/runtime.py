"""What the running program has open, and the adoption of another program.

A program is adopted in three steps, in which the same participants take part. The first program is adopted like any
other, after the image of a head start if there is one. So a reload, from top to bottom, is `prepare` down this table,
then `adopt` up, then `finish` up; if a step is refused, `undo` up the table leaves everything as it was.

| participant | prepare | adopt | finish |
|---|---|---|---|
| `ThreadCounts` | room for the counts | the new indexes | free indexes of series that are gone |
| `Sockets` | open listeners and senders | send and receive there | close the unused |
| `Images` | write and load the image; deadmen send at the start | | end and free what only the earlier image had |
| `Topics` | open publishers and subscriptions | await events there | close the unused |
| `Plane` | bind the image to topics, start threads | each thread changes between two messages; may refuse | |
| `Services` | open new services | end the open calls; send by the new image | close the unused |
| `Gateways` | open new gateways | close the unused; may refuse | serve their clients |

Down the table, each needs what is above it. Up the table, each stops using what is above it: gateways close before the
deadmen of their clients publish a last time, and the threads change before sockets and topics are closed. Nothing is
closed while a thread that is stuck in the middleware may use it: then `finish` waits for the next reload, except for
gateways.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack

from router.app.change import Change
from router.app.gateways import Gateways
from router.app.plane import Images, Plane
from router.app.services import Services
from router.app.sockets import KernelDrops, Sockets
from router.app.topics import Topics
from router.carrier.forwarding import Forwarding
from router.compiler.compiled_table import CompiledTable
from router.compiler.extras import missing_extras
from router.errors import ConfigurationError
from router.log import fault, logger
from router.net.dds import clashes, discovers_by_multicast
from router.net.kernel import BELOW_ROS
from router.observe.reports import Reporter
from router.startup_image.head_start import HeadStart
from router.threads import background_threads

_STALLED_S = 0.01
"""Threshold in seconds: publish calls that have taken less are reported as 0."""


class Runtime:
    """The sockets, ROS node, gateways and threads of the running program."""

    def __init__(
        self,
        plane: Plane,
        forwarding: Forwarding,
        reporter: Reporter,
        ros_args: Sequence[str],
        head_start: HeadStart | None = None,
    ) -> None:
        self.plane = plane
        self.drops = KernelDrops()
        self.counts = plane.counts
        self.sockets = Sockets(self.drops, plane.library, head_start)
        self.topics = Topics(ros_args, self._note_incompatible, plane.subscriber_joined)
        self.gateways = Gateways(self.topics, self.drops, self.counts, reporter, forwarding.published.wake)
        self.services = Services(self.topics, plane, self.counts, reporter)
        self._images = Images(forwarding, head_start)
        self._unfinished: list[Change] = []

    @property
    def program(self) -> CompiledTable | None:
        """The running program."""
        return self.plane.now.program if self.plane.now else None

    def stalled(self) -> dict[str, float]:
        """Return the seconds for which a publish call has been in the middleware, by topic; 0 if no call is running."""
        stalled = dict.fromkeys((plan.label for plan in self.program.publishers) if self.program else (), 0.0)
        for topic, seconds in (*self.topics.stalled(), *self.plane.stalled()):
            if seconds >= _STALLED_S:
                stalled[topic] = max(seconds, stalled.get(topic, 0.0))
        return stalled

    def _note_incompatible(self, counter: int, peers: int) -> None:
        self.counts.events[counter] = peers

    # adoption of a program

    def start(self, program: CompiledTable) -> Change:
        """Adopt the first program, then open its gateways, which takes longer. Raises StartError: then close it."""
        with background_threads():
            change = self._prepare(program)
        self.adopt(change)
        with background_threads():
            self.gateways.prepare(change)
            self.finish(change)
        return change

    def prepare(self, program: CompiledTable) -> Change:
        """Open what `program` needs that is not open yet. Raises StartError with nothing changed."""
        if self._unfinished and self.plane.wait_until_adopted():
            self._finish_all()  # before `program` opens the same addresses or topics
        change = self._prepare(program)
        with ExitStack() as undo:
            undo.callback(self.undo, change)
            self.gateways.prepare(change)
            undo.pop_all()
        return change

    def _prepare(self, program: CompiledTable) -> Change:
        for missing in missing_extras(program.table):
            raise missing
        _check_ports(program, os.environ)
        self.topics.check(program)
        change = Change(program, self.plane.image, is_first=self.plane.now is None)
        with ExitStack() as undo:
            undo.callback(self.undo, change)
            for each in (self.counts, self.sockets, self._images, self.topics, self.plane, self.services):
                each.prepare(change)
            undo.pop_all()
        return change

    def undo(self, change: Change) -> None:
        """Close what was opened for a program that is not adopted."""
        with ExitStack() as up:  # all of them, even if one raises
            for each in (self.sockets, self.topics, self.services, self.gateways):
                up.callback(each.undo, change)

    def adopt(self, change: Change) -> None:
        """Switch to the prepared program. Raises StuckError or StartError with nothing changed."""
        try:
            self.gateways.adopt(change)
            self.plane.adopt(change)
        except BaseException:
            self.undo(change)
            raise
        try:
            with ExitStack() as up:  # all of them, even if one raises
                for each in (self.counts, self.sockets, self.topics, self.services):
                    up.callback(each.adopt, change)
        except Exception as error:  # noqa: BLE001 a bug is logged: the program runs
            fault(error, "occurred after the threads had changed to another program").log()

    def finish(self, change: Change) -> None:
        """Close what only the earlier program used; all of it, even if closing something raises."""
        self._unfinished.append(change)
        with ExitStack() as up:
            if change.before is None or self.plane.wait_until_adopted():
                up.callback(self._finish_all)
            up.callback(self.gateways.finish, change)

    def _finish_all(self) -> None:
        """Finish this adoption and earlier ones that could not, the newest first. Try each once."""
        changes, self._unfinished = self._unfinished, []
        with ExitStack() as up:
            for change in changes:
                for each in (self.counts, self.sockets, self._images, self.topics, self.services):
                    up.callback(each.finish, change)

    def take_over(self, program: CompiledTable) -> None:
        """Adopt a program: the whole of a reload. Raises StartError, StuckError or OSError with nothing changed.

        A failure after the adoption is a bug and is logged.
        """
        change = self.prepare(program)
        self.adopt(change)
        try:
            self.finish(change)
        except Exception as error:  # noqa: BLE001 a bug is logged; the program keeps running
            fault(error, "prevented it from closing unused sockets and topics").log()

    # stopping

    def close_with(self, closing: ExitStack) -> None:
        """Have `closing` close sockets and ROS, after the services that use them."""
        closing.callback(self._close_listeners)
        closing.callback(self.sockets.close_senders)
        closing.callback(self.topics.close)

    def end_with(self, closing: ExitStack) -> None:
        """Have `closing` end what sends commands, each before what carries them on; deadmen of routes send last.

        The threads for messages from ROS carry the last messages of clients and of their deadmen to boards.
        """
        closing.callback(self.plane.close)
        closing.callback(self._stop_ros)
        closing.callback(self._end_client_deadmen)
        closing.callback(self.gateways.close)
        closing.callback(self._stop_plane)
        closing.callback(self.services.close)

    def _stop_plane(self) -> None:
        self._unless_stuck(self.plane.stop, self.sockets.listeners)

    def _end_client_deadmen(self) -> None:
        self._unless_stuck(self.plane.end_client_deadmen)

    def _stop_ros(self) -> None:
        self._unless_stuck(self.plane.stop_ros)

    def _unless_stuck(self, stop: Callable[..., bool], *arguments: object) -> None:
        """Stop threads. If one is stuck in the middleware, leave open what it uses."""
        if not stop(*arguments):
            self.topics.leave_open()

    def _close_listeners(self) -> None:
        if self.plane.has_stopped:  # else `stop` is stuck, and a thread receives from their descriptors
            self.sockets.close_listeners()


def _check_ports(program: CompiledTable, variables: Mapping[str, str]) -> None:
    """Warn of UDP ports that ROS uses. Raises ConfigurationError for one without which ROS in this router is blind."""
    for clash in clashes(program, variables):
        if clash.blinds and program.uses_ros and discovers_by_multicast(variables):
            raise ConfigurationError(
                f"{clash.span}: {clash}", f"{BELOW_ROS}; or give all ROS nodes another ROS_DOMAIN_ID"
            )
        logger.warning(str(clash), remedy=BELOW_ROS)
