"""Why a robot stopped, found in a recording: each deadman that tripped, what fed it last, and what was lost before."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from router.datagrams import Wire
from router.errors import plural
from router.observe.health import REMEDIES
from router.observe.problems import Kind
from router.recording.about import RecordedRoute
from router.recording.mirror import BRAKED, FED, LOST, RELEASED, RETURNED, SENT, TRIPPED, Action
from router.recording.reader import Recorded, RecordedAction
from router.table.model.routes import ANY
from router.tools.tap import local_time, utc_text
from router.types.protobuf import Envelope
from router.values.printing import compact, time_text

_MS = 1_000_000
_UNKNOWN = RecordedRoute("", (), False, 0.0, ())


@dataclass(slots=True)
class Tally:
    """Commands that did not get through for one reason. Times in ns. `detail` is that of the last one.

    They were `rejected` or `dropped` (`decision`). `is_own`: their sender is a source of the route.
    """

    decision: str
    reason: str
    case: str
    sender: str
    is_own: bool
    count: int = 0
    first: int = 0
    last: int = 0
    detail: str = ""

    def add(self, at: int, detail: str = "") -> None:
        self.first = self.first if self.count else at
        self.count += 1
        self.last, self.detail = at, detail

    @property
    def words(self) -> str:
        """What happened: `5 manual_drive from basestation were rejected: source_mismatch`."""
        source = f" from {self.sender}" if self.sender else ""
        verb = "was" if self.count == 1 else "were"
        what = f"{self.count} {self.case}" if self.case else plural(self.count, "datagram")
        return f"{what}{source} {verb} {self.decision}: {self.reason}"

    def __str__(self) -> str:
        times = _clock(self.first) if self.count == 1 else f"{_clock(self.first)} to {_clock(self.last)}"
        return f"{self.words}, {times}" + (f" ({self.detail})" if self.detail else "")


@dataclass(frozen=True, slots=True)
class Fed:
    """The last command that fed a deadman: when it was sent (ns), its payload, and who sent it.

    Of a message of a gateway's client, recordings have only the time: `case` is "".
    """

    at: int
    case: str
    payload: str
    sender: str


@dataclass(slots=True)
class Stop:
    """A deadman that tripped `at` a time (ns).

    `lost` are the commands of its route that did not get through since `fed`. `heard` and `heard_again`: when each
    source and board was heard last before the stop, and first after it. `brakes` counts what the deadman sent, by
    payload case, endpoint and reason of failure ("" if it was sent). `obeyed` tells which boards have shown that they
    stopped.
    """

    at: int
    route: str
    settings: RecordedRoute
    fed: Fed | None
    begin: int
    lost: Sequence[Tally]
    heard: Mapping[str, tuple[int, str]]
    heard_again: dict[str, int] = field(default_factory=dict)
    brakes: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    obeyed: list[str] = field(default_factory=list)
    released: int | None = None

    def lines(self) -> list[str]:
        """Return the stop first, its cause second, the remedy third, and then the details."""
        cause, remedy = self._cause()
        return [
            f"{_clock(self.at)} {self._what()}",
            f"  cause     {cause}",
            *([f"  remedy    {remedy}"] if remedy else []),
            f"  last fed  {self._last_fed()}",
            *(f"  lost      {loss}" for loss in self.lost),
            *(f"  sent      {brake}" for brake in self._sent()),
            *(f"  board     {self._board(board)}" for board in self.settings.brakes),
            *(f"  obeyed    {answer}" for answer in self.obeyed),
            f"  released  {self._release()}",
        ]

    def json(self) -> str:
        """Return one JSON object."""
        cause, remedy = self._cause()
        fed = self.fed
        return json.dumps(
            {
                "time": utc_text(local_time(self.at)),
                "route": self.route,
                "stopped": [*self.settings.brakes],
                "cause": cause,
                "remedy": remedy,
                "last_fed": None
                if fed is None
                else {"time": utc_text(local_time(fed.at)), "case": fed.case, "sender": fed.sender},
                "lost": [
                    {
                        "decision": loss.decision,
                        "reason": loss.reason,
                        "case": loss.case,
                        "sender": loss.sender,
                        "count": loss.count,
                        "detail": loss.detail,
                    }
                    for loss in self.lost
                ],
                "sent": [
                    {"case": case, "endpoint": endpoint, "problem": problem, "count": count}
                    for (case, endpoint, problem), count in self.brakes.items()
                ],
                "obeyed": self.obeyed,
                "released": None if self.released is None else utc_text(local_time(self.released)),
            }
        )

    @property
    def _topic(self) -> str:
        """The topic of a gateway's clients whose deadman it is, or ""."""
        return self.route.partition(":")[2]

    def _board(self, name: str) -> str:
        heard, _ = self.heard.get(name, (None, ""))
        again = self.heard_again.get(name)
        before = f"last heard {_length(self.at - heard)} before" if heard else "not heard before"
        after = f"{_length(again - self.at)} after" if again else "not after"
        return f"{name} was {before} the stop, and {after} it"

    def _what(self) -> str:
        braked = f" and braked {' and '.join(self.settings.brakes)}" if self.settings.brakes else ""
        since = f", {_length(self.at - self.fed.at)} after the last command" if self.fed else ""
        return f"the deadman of {self.route} tripped{braked}{since}"

    def _cause(self) -> tuple[str, str]:
        """Return the cause, and its remedy or ""."""
        sources, heard = self.settings.sources, self.heard
        if self._topic:
            return f"no client published on {self._topic}", "Check that the client runs and reaches the gateway."
        if self.lost:
            worst = max(self.lost, key=lambda loss: loss.count)
            silent = [self._silence(source) for source in sources if not worst.is_own and self._is_silent(source)]
            return "; ".join((worst.words, *silent)), REMEDIES.get(worst.reason, "")
        if self.settings.is_from_ros:
            topics = " or ".join(sources)
            return (
                f"no message arrived on {topics}",
                "`ros2 topic info -v` shows who publishes, `ros2 topic hz` how often.",
            )
        if not sources:
            return f"no command of {self.route} was sent", ""
        hosts = [heard[source][1] for source in sources if source in heard and self._is_silent(source)]
        remedy = Kind.ENDPOINT_SILENT.remedy_at(hosts[0]) if len(hosts) == len(sources) else ""
        return "; ".join(map(self._silence, sources)), remedy

    def _is_silent(self, source: str) -> bool:
        heard, _ = self.heard.get(source, (None, ""))
        return heard is None or self.at - heard > self.settings.timeout_ms * _MS / 2

    def _silence(self, source: str) -> str:
        if source == ANY:
            return f"no {self.settings.case} arrived"
        if source not in self.heard:
            return f"{source} was not heard since {_clock(self.begin)}, where the recording begins"
        heard, _ = self.heard[source]
        if not self._is_silent(source):
            return f"{source} was heard until {_clock(heard)}, but sent no {self.settings.case}"
        again = self.heard_again.get(source)
        until = f"until {_clock(again)} ({_length(again - heard)})" if again else "until the end of the recording"
        return f"{source} was silent from {_clock(heard)} {until}"

    def _last_fed(self) -> str:
        if self.fed is None:
            return f"never since {_clock(self.begin)}, where the recording begins; the one before it may show it"
        if self._topic:
            return f"{_clock(self.fed.at)} by a client's message"
        source = f" from {self.fed.sender}" if self.fed.sender else ""
        return f"{_clock(self.fed.at)} by {self.fed.case}{source}: {self.fed.payload or 'no fields'}"

    def _sent(self) -> list[str]:
        return [
            f"{case or 'nothing'} to {endpoint}, {count} times" + (f", not sent: {problem}" if problem else "")
            for (case, endpoint, problem), count in self.brakes.items()
        ] or [f"its message on {self._topic}, which is not recorded" if self._topic else "nothing that is recorded"]

    def _release(self) -> str:
        if self.released is None:
            return "not in this recording"
        return f"{_clock(self.released)}, after {_length(self.released - self.at)}"


@dataclass(slots=True)
class _State:
    """A route with a deadman, up to now."""

    fed: Fed | None = None
    lost: dict[tuple[str, str, str, str], Tally] = field(default_factory=dict)
    stop: Stop | None = None

    def tally(self, *what: str, is_own: bool) -> Tally:
        """Return the tally of this decision, reason, case and sender."""
        decision, reason, case, sender = what
        return self.lost.setdefault((decision, reason, case, sender), Tally(decision, reason, case, sender, is_own))


class Stops:
    """Finds the stops in the entries of a recording, taken in the order of time.

    `routes` are those of the table that ran. `has_actions`: the recording has what the router did by itself.
    `silences`: endpoints that were heard again after a silence.
    """

    def __init__(self, routes: Mapping[str, RecordedRoute], wire: Wire) -> None:
        self.found: list[Stop] = []
        self.silences: list[Action] = []
        self.has_actions = False
        self._routes = routes
        self._wire = wire
        self._states = {name: _State() for name, route in routes.items() if route.timeout_ms}
        self._begin: int | None = None
        self._heard: dict[str, tuple[int, str]] = {}
        self._commands: dict[str, dict[str, int]] = {}  # by case and sender: when one was accepted last

    def take(self, entry: Recorded | RecordedAction) -> None:
        if self._begin is None:
            self._begin = entry.at
        if isinstance(entry, Recorded):
            self._received(entry)
        else:
            self.has_actions = True
            self._did(entry.action)

    def note_answers(self, answers: str) -> None:
        """Add what boards have shown (the key `obeyed` of the metadata) to the stops that caused the recording."""
        last = {stop.route: stop for stop in self.found}
        for answer in filter(None, answers.split("; ")):
            route, _, text = answer.partition(": ")
            if route in last:
                last[route].obeyed.append(text)

    def _received(self, it: Recorded) -> None:
        sender, case = it.endpoint or it.peer[0], _first_case(self._wire.envelopes.at(it.listener), it.data)
        self._heard[sender] = it.at, it.peer[0]
        for state in self._states.values():
            if (stop := state.stop) is not None and sender in (*stop.settings.sources, *stop.settings.brakes):
                stop.heard_again.setdefault(sender, it.at)
        if not it.reason:
            self._commands.setdefault(case, {})[sender] = it.at
            return
        for name, state in self._states.items():
            route = self._routes.get(name)  # none for a gateway's client
            if route and not route.is_from_ros and (case == route.case or (not case and sender in route.sources)):
                state.tally("rejected", it.reason, case, sender, is_own=sender in route.sources).add(it.at)

    def _did(self, it: Action) -> None:
        if it.what == RETURNED:
            self.silences.append(it)
            return
        state = self._states.setdefault(it.route, _State()) if it.what in (TRIPPED, FED) else self._states.get(it.route)
        if state is None:
            return
        if it.what in (SENT, FED):
            state.fed = self._fed(it) if it.what == SENT else Fed(it.at, "", "", "a client")
            state.lost = {}
        elif it.what == LOST:
            sender = f"topic {it.topic}" if it.topic else self._sender(it.route)
            case = self._routes.get(it.route, _UNKNOWN).case
            state.tally("dropped", it.reason, case, sender, is_own=True).add(it.at, it.detail)
        elif it.what == TRIPPED:
            self._tripped(it, state)
        elif it.what == RELEASED and state.stop is not None:
            state.stop.released, state.stop = it.at, None
        elif it.what == BRAKED and state.stop is not None:
            case = _first_case(self._wire.envelopes.to(it.target), it.data)
            state.stop.brakes[case, it.target, ": ".join(filter(None, (it.reason, it.detail)))] += 1

    def _tripped(self, it: Action, state: _State) -> None:
        settings, begin = self._routes.get(it.route, _UNKNOWN), self._begin or it.at
        heard = {name: self._heard[name] for name in (*settings.sources, *settings.brakes) if name in self._heard}
        state.stop = Stop(it.at, it.route, settings, state.fed, begin, [*state.lost.values()], heard)
        self.found.append(state.stop)

    def _fed(self, it: Action) -> Fed:
        decoded = self._wire.decode(it.data, self._wire.envelopes.to(it.target))
        sender = f"topic {it.topic}" if it.topic else self._sender(it.route)
        return Fed(it.at, decoded.case.name, compact(decoded.message, decoded.case.type), sender)

    def _sender(self, route: str) -> str:
        """Return who sent the last command that the route accepted; "" if that is not in the recording."""
        settings = self._routes.get(route, _UNKNOWN)
        known = self._commands.get(settings.case, {})
        senders = [sender for sender in known if sender in settings.sources or ANY in settings.sources]
        return max(senders, key=lambda sender: known[sender], default="")


def _first_case(envelope: Envelope, data: bytes) -> str:
    return next(iter(envelope.cases_in(data)), "")


def _clock(at: int) -> str:
    return time_text(local_time(at))


def _length(ns: int) -> str:
    return f"{ns / 1e6:.0f} ms" if ns < 1e9 else f"{ns / 1e9:.2f} s"
