"""What boards show about the brakes of deadmen, for the log, and for `health`, which says what they report instead."""

from __future__ import annotations

import threading
from collections.abc import Mapping

from router.compiler.metrics import Answer, Evidence
from router.compiler.program import Program
from router.datagrams import Wire
from router.errors import DecodeError
from router.log import logger
from router.values import protobuf_tree, words

MOST_FIELDS = 4
"""Maximum number of fields of a message that a text names."""
_DIGITS = 3

Said = Mapping[tuple[str, str], str]
"""By a deadman's route and a board: the fields of `obeyed` in its last message that did not meet the condition."""


class Obedience:
    """The last message of each board that has not obeyed, while its deadman sends. Thread-safe."""

    def __init__(self) -> None:
        self._said: dict[tuple[str, str], str] = {}
        self._lock = threading.Lock()

    def said(self) -> Said:
        with self._lock:
            return self._said.copy()

    def forget(self, route: str) -> None:
        """Forget what boards have said about the deadman of a route: it trips, or is released."""
        with self._lock:
            self._said = {key: said for key, said in self._said.items() if key[0] != route}

    def note(self, evidence: Evidence, program: Program) -> None:
        """Keep what a board says while it does not obey."""
        if said := _read_fields(evidence, program):
            with self._lock:
                self._said[evidence.route, evidence.endpoint] = said

    def answered(self, answer: Answer, program: Program) -> None:
        """Log that a board obeys, or does not."""
        after, key = f"{answer.after / 1e9:.2f} s", (answer.route, answer.endpoint)
        if answer.obeys:
            with self._lock:
                self._said.pop(key, None)
            logger.info("the rover has stopped", route=answer.route, board=answer.endpoint, after=after)
            return
        why = why_disobeyed(program, *key, self.said())
        what = "the board does not obey the brake; stop the rover by other means"
        logger.error(what, route=answer.route, board=answer.endpoint, after=after, detail=why)


def why_disobeyed(program: Program, route: str, board: str, said: Said) -> str:
    """Return what the deadman of a route sends, and what the board says to that."""
    deadman = next((each.deadman for each in program.table.routes if each.name == route), None)
    if deadman is None or deadman.obeyed is None:  # a reload has removed it meanwhile
        return ""
    sent, case = f"{deadman.case.value} {deadman.fields}", deadman.obeyed.case.value
    answer = f"says {said[route, board]}" if (route, board) in said else f"has sent no {case} since"
    return f"it was sent {sent}, and {answer}"


def _read_fields(evidence: Evidence, program: Program) -> str:
    """Return the fields that the condition of `obeyed` reads in a datagram, on one line."""
    try:
        decoded = Wire(program.envelope).decode(evidence.data)
        names = program.lowered.obeyed[evidence.route].layout.names
    except (DecodeError, KeyError):  # a reload has changed the messages or the deadmen meanwhile
        return ""
    tree = protobuf_tree(decoded.message, decoded.case.type, _DIGITS)
    read = [word for word in words(tree) if word.partition("=")[0] in names]
    more = [f"and {len(read) - MOST_FIELDS} more"] if len(read) > MOST_FIELDS else []
    return f"{decoded.case.name} {' '.join(read[:MOST_FIELDS] + more) or 'with defaults only'}"
