"""What a running router receives, one by one, as `tapping` shows it: of some payload cases, under a condition.

Knows the stream; `running_router` connects.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Collection, Iterable, Iterator

from router.engine.wire import Wire
from router.errors import DecodeError
from router.observe.tap_stream import Lost
from router.recording.mirror import MirroredDatagram
from router.tools.conditions import Condition
from router.tools.tapping import Heard


class RunningTap:
    """Takes batches of a stream apart. `missed` counts what the router could not send, because this is too slow.

    Without `cases` and `condition` everything is shown, also what is no payload.
    """

    def __init__(
        self,
        wire: Wire,
        name_of: Callable[..., str],
        cases: Collection[str] = (),
        condition: Condition | None = None,
    ) -> None:
        self.missed = 0
        self._wire = wire
        self._name_of = name_of
        self._cases = cases
        self._condition = condition

    def take(self, batches: Iterable[list[MirroredDatagram | Lost]]) -> Iterator[list[Heard]]:
        """For each batch what is to be shown of it, which may be nothing."""
        for batch in batches:
            shown = []
            for each in batch:
                if isinstance(each, Lost):
                    self.missed += each.number
                elif (heard := self._heard(each)) is not None:
                    shown.append(heard)
            yield shown

    def _heard(self, seen: MirroredDatagram) -> Heard | None:
        """None where it is not wanted."""
        peer = self._name_of(seen.peer, seen.listener)
        try:
            decoded = self._wire.decode(seen.data)
        except DecodeError as error:
            is_wanted = not self._cases and self._condition is None
            return Heard(_time(seen), peer, seen.data, None, str(error)) if is_wanted else None
        case = decoded.case.name
        if self._cases and case not in self._cases:
            return None
        if self._condition is not None and not self._condition.holds(case, decoded.message, peer, seen.at):
            return None
        return Heard(_time(seen), peer, seen.data, decoded)


def _time(seen: MirroredDatagram) -> dt.datetime:
    return dt.datetime.fromtimestamp(seen.at / 1e9).astimezone()
