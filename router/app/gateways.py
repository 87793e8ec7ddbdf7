"""The gateways of the running program, whose thread is started with the first one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

from router.app.change import Change
from router.app.counts import ThreadCounts
from router.app.sockets import KernelDrops
from router.app.topics import Topics
from router.library import library
from router.observe.reports import Reporter

if TYPE_CHECKING:
    from router.gateway.thread import GatewayThread


class Gateways:
    """Serves clients of the topics. `drops` follows what the kernel drops, `refused` counts refused connections.

    `publish_newest` wakes the thread that publishes datagrams.
    """

    def __init__(
        self,
        topics: Topics,
        drops: KernelDrops,
        counts: ThreadCounts,
        reporter: Reporter,
        publish_newest: Callable[[], None],
    ) -> None:
        self.thread: GatewayThread | None = None
        self.refused: Counter[str] = Counter()
        self._topics = topics
        self._drops = drops
        self._counts = counts
        self._reporter = reporter
        self._publish_newest = publish_newest

    # adoption of another program

    def prepare(self, change: Change) -> None:
        """Open the gateways that are not open yet. Raises StartError."""
        if self._topics.node is None or not (change.program.gateways or self.thread):
            return
        if self.thread is None:
            self.thread, change.starts_gateways = self._start_thread(), True
        deadmen = change.image.client_deadmen if change.image else {}
        feed = {name: deadman.feed for name, deadman in deadmen.items()}
        change.gateways = self.thread.prepare(change.program, feed)

    def undo(self, change: Change) -> None:
        """Close the gateways that `prepare` has opened, and reopen those that it or `adopt` has closed."""
        if self.thread is not None and change.gateways is not None:
            self.thread.undo(change.gateways)
        if change.starts_gateways:
            self.close()

    def adopt(self, change: Change) -> None:
        """Close the gateways that the program does not have. Raises StuckError."""
        if self.thread is not None and change.gateways is not None:
            self.thread.adopt(change.gateways)

    def finish(self, change: Change) -> None:
        """Serve the clients of new gateways."""
        if self.thread is None or change.gateways is None:
            return
        for service in change.gateways.unused:
            self._drops.unfollow(service.name)
        for service in change.gateways.opened:
            if service.name in self.thread.kernel_drops:
                self._drops.follow(service.name, self.thread.kernel_drops[service.name])
        self.thread.finish(change.gateways)

    def _start_thread(self) -> GatewayThread:
        from router.gateway.thread import GatewayThread  # asyncio and websockets take 0.1 s to import

        assert self._topics.node is not None  # noqa: S101 - gateways need topics, which are open
        reporter = self._reporter
        return GatewayThread(
            self._topics.node,
            library(),
            self._counts.gateways,
            reporter.report,
            reporter.failed,
            self.refused,
            self._publish_newest,
        )

    def close(self) -> None:
        """Close all gateways and end their thread."""
        if self.thread is not None:
            self.thread.stop()
            self.thread = None
