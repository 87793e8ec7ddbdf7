"""What boards show about the brakes of deadmen, for the log, and for `health`, which says what they report instead."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from google.protobuf.message import Message

from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Answer, Evidence
from router.datagrams import Wire
from router.errors import DecodeError, listed
from router.log import logger
from router.values.printing import protobuf_tree, words

MOST_FIELDS = 4
"""Maximum number of fields of a message that a text names."""
_DIGITS = 3


class Reply(NamedTuple):
    """What a board has shown since a deadman tripped.

    `stopped`: seconds from the first brake until it had stopped, None if it has not. `said`: the fields of `obeyed` in
    its last message that did not meet the condition, "" if there was none.
    """

    stopped: float | None = None
    said: str = ""


Replies = Mapping[tuple[str, str], Reply]
"""By the deadman's route, and the board."""


class Obedience:
    """The replies of boards to the deadmen that send now. Thread-safe."""

    def __init__(self) -> None:
        self._replies: dict[tuple[str, str], Reply] = {}
        self._lock = threading.Lock()

    def replies(self) -> Replies:
        with self._lock:
            return self._replies.copy()

    def forget(self, route: str) -> None:
        """Forget the replies to the deadman of a route, which trips or is released."""
        with self._lock:
            self._replies = {key: reply for key, reply in self._replies.items() if key[0] != route}

    def note(self, evidence: Evidence, program: CompiledTable) -> None:
        """Note what a board says while it does not obey."""
        if said := _read_fields(evidence, program):
            self._set(evidence.route, evidence.endpoint, Reply(None, said))

    def answered(self, answer: Answer, program: CompiledTable) -> None:
        """Note and log that a board obeys, or does not."""
        after, place = f"{answer.after / 1e9:.2f} s", {"route": answer.route, "board": answer.endpoint}
        if answer.obeys:
            self._set(answer.route, answer.endpoint, Reply(answer.after / 1e9))
            logger.info("the board has stopped", **place, after=after)
        else:
            why = why_disobeyed(program, answer.route, answer.endpoint, self.replies())
            what = "the board does not obey the brake; stop the rover by other means"
            logger.error(what, **place, after=after, detail=why)

    def _set(self, route: str, board: str, reply: Reply) -> None:
        with self._lock:
            self._replies[route, board] = reply


def why_disobeyed(program: CompiledTable, route: str, board: str, replies: Replies) -> str:
    """Return what the deadman of a route sends, and what the board says to that."""
    deadman = next((each.deadman for each in program.table.routes if each.name == route), None)
    if deadman is None or deadman.obeyed is None:  # a reload has removed it meanwhile
        return ""
    sent, case = listed([*map(str, deadman.payloads)]), deadman.obeyed.case.value
    said = replies.get((route, board), Reply()).said
    return f"it was sent {sent}, and {f'says {said}' if said else f'has sent no {case} since'}"


def _read_fields(evidence: Evidence, program: CompiledTable) -> str:
    """Return the fields that the condition of `obeyed` reads in a datagram, on one line."""
    try:
        (obeyed,) = (each.obeyed for each in program.deadmen if each.route == evidence.route and each.obeyed)
        decoded = Wire(program.envelopes).decode(evidence.data, program.envelopes.of(obeyed.case.name))
        names = program.lowered.obeyed[evidence.route].layout.names
    except (DecodeError, KeyError, ValueError):  # a reload has changed the messages or the deadmen meanwhile
        return ""
    tree = protobuf_tree(decoded.message, decoded.case.type, _DIGITS)
    read = [word for word in words(tree) if word.partition("=")[0] in names]
    read += [f"no {path}" for path in _absent(decoded.message, names)]
    more = [f"and {len(read) - MOST_FIELDS} more"] if len(read) > MOST_FIELDS else []
    return f"{decoded.case.name} {', '.join(read[:MOST_FIELDS] + more) or 'with defaults only'}"


def _absent(message: Message, names: Iterable[str]) -> Iterator[str]:
    """Yield the fields that are not set, of those whose presence the condition reads: `has(front_left_motor)`."""
    for name in names:
        path = name.removeprefix("has(").removesuffix(")")
        if path != name and path.isidentifier() and not message.HasField(path):
            yield path
