"""Random tables, messages, times and reloads through the engine in Python and through the library: both do the same.

    python -m benchmarks.judge_stage --count 1000000 --seed 1

Compared are, after each step, what each endpoint and topic gets, in order and with its time, and how often what was
counted. Exits 1 for any difference, and says by which seed the table is made again.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

from router.compiler import Checked, check_table
from router.compiler.lookup import Definitions
from router.compiler.program import Program, TargetPlan
from router.errors import Severity
from router.rehearsal.rehearsal import Dropped, Event, Published, Rehearsal, Rejected, Sent
from router.table.model import OnLimit
from router.types.model import MessageType
from tests.carrier.random_tables import PEERS, RandomTable, Tables, datagram, ros_message
from tests.mutations import MUTATIONS
from tests.oracles.engine_rehearsal import EngineRehearsal
from tests.oracles.python_engine.handlers import remember
from tests.tables import PROTOS

MS = 1_000_000
STEPS = 1000
"""For one table and those that replace it."""

LEAST_START = 1_700_000_000_000_000_000


class Judge:
    """One table and its successors, made by a seed, in both."""

    def __init__(self, folder: Path, definitions: Definitions, seed: int) -> None:
        self.fates: Counter[str] = Counter()
        self.steps = 0
        self._noise = random.Random(seed)
        self._tables = Tables(self._noise)
        self._path, self._definitions = folder / "table.yaml", definitions
        self._table, self._checked, program = self._made(None)
        self._both = EngineRehearsal(program), Rehearsal(program)
        self._program = program
        self._done: list[str] = []

    @property
    def history(self) -> str:
        return "\n".join((self._table.text, *self._done[-5:]))

    def _made(self, previous: RandomTable | None) -> tuple[RandomTable, Checked, Program]:
        """A table without errors."""
        while True:
            table = self._tables.next(previous) if previous else self._tables.table()
            self._path.write_text(table.text.replace("PROTOS", str(PROTOS)))
            checked = check_table(self._path, {}, self._definitions)
            remember(checked)
            program = checked.program_in(self._program.counters.continued()) if previous else checked.program
            if program is not None and (previous is None or _is_comparable(self._program, program)):
                return table, checked, program
            if program is not None:
                self.fates["not comparable"] += 1
                continue
            first = next(each for each in checked.diagnostics if each.severity is Severity.ERROR)
            self.fates[f"refused: {first.message[:60]}"] += 1

    def run(self, steps: int) -> str | None:
        """Returns the first difference."""
        for _ in range(steps):
            self.steps += 1
            self._step()
            if found := self._difference():
                return found
        for each in self._both:
            each.close()
        self._done.append("close")
        return self._difference()

    def _step(self) -> None:
        noise = self._noise
        passes = noise.choice((0, 0, 1, MS, MS, *(noise.randrange(most * MS) for most in (2, 20, 20, 60, 600))))
        to = self._both[0].now + passes
        self._done.append(f"advance {passes}")
        for each in self._both:
            each.advance(to)
        if noise.random() < 0.01:
            ahead = noise.choice((0, 3 * MS, -50 * MS, noise.randrange(600 * MS), 3600 * 1000 * MS))
            self._done.append(f"set clock {ahead}")
            for each in self._both:
                each.set_clock(ahead)
        chance = noise.random()
        if chance < 0.01:
            self._reload()
        elif chance < 0.7 or not self._program.subscriptions:
            self._datagram(to)
        else:
            self._message(to)

    def _reload(self) -> None:
        self._table, self._checked, self._program = self._made(self._table)
        self._done.append("reload")
        self.fates["reload"] += 1
        for each in self._both:
            each.reload(self._program)

    def _datagram(self, now: int) -> None:
        noise = self._noise
        data = datagram(noise)
        if data and noise.random() < 0.1:
            data = noise.choice(MUTATIONS)(noise, data, data)
        listener, peer = noise.choice(("trimmed", "exact")), noise.choice(PEERS)
        arrived = self._wall(now) - noise.choice((0, 0, noise.randrange(250 * MS)))
        self._done.append(f"datagram {listener} {peer} {data.hex()} {arrived - now}")
        for each in self._both:
            each.datagram(listener, peer, data, arrived)

    def _message(self, now: int) -> None:
        noise = self._noise
        topic = noise.choice(self._program.subscriptions).label
        data = ros_message(noise, self._type(topic))
        sent = self._wall(now) - noise.choice((0, 0, noise.randrange(250 * MS), -5 * MS))
        self._done.append(f"message {topic} {data.hex()} {sent - now}")
        for each in self._both:
            each.ros(topic, data, sent)

    def _wall(self, now: int) -> int:
        return now + self._both[0].ahead

    def _type(self, topic: str) -> MessageType:
        subscriptions = [each for route in self._checked.routes for each in route.subscriptions]
        return next(each.type for each in subscriptions if each.topic.topic.value == topic)

    def _difference(self) -> str | None:
        python, library = ([_without_detail(event) for event in each.events] for each in self._both)
        for each in self._both:
            each.events.clear()
        self.fates.update(_fate(event) for event in library)
        found = []
        targets = {event.target for event in (*python, *library) if isinstance(event, (Sent, Published))}
        for target in sorted(targets):
            left, right = (_delivered(target, events) for events in (python, library))
            if left != right:
                found.append(f"{target} gets {right}, not {left}")
        counts = [
            Counter(event for event in events if not isinstance(event, (Sent, Published)))
            for events in (python, library)
        ]
        if counts[0] != counts[1]:
            found.append(f"only Python: {counts[0] - counts[1]}, only the library: {counts[1] - counts[0]}")
        return "\n".join(found) or None


def _delivered(target: str, events: Sequence[Event]) -> list[Event]:
    """What a target gets, in order; deadmen that send at one time do so in any order."""
    delivered = [event for event in events if isinstance(event, (Sent, Published)) and event.target == target]
    runs = groupby(delivered, lambda event: (event.at, isinstance(event, Sent) and event.by_deadman))
    return [event for (_, brakes), run in runs for event in (sorted(run, key=repr) if brakes else run)]


def _is_comparable(earlier: Program, later: Program) -> bool:
    """Whether both keep the same state at a reload.

    What `on_limit: latest` holds, the library keeps by names, Python by all that the table says of the target. What
    waits for a bandwidth leaves at once where the topic of the message's route changes; Python keeps it waiting. What
    leaves later feeds the deadmen of the next table, in Python those of its own.
    """
    before, after = (_targets(program) for program in (earlier, later))
    routes = {(route, label) for route, _, label in after}
    for place, target in before.items():
        route, _, label = place
        if place not in after and target.is_deferred and (route, label) in routes:
            return False
        if target.is_deferred and place in after and target.deadmen != after[place].deadmen:
            return False
        is_held = target.on_limit is OnLimit.LATEST and place in after
        if is_held and target != after[place] and target.max_rate == after[place].max_rate:
            return False
    return True


def _targets(program: Program) -> dict[tuple[str, str | None, str], TargetPlan]:
    return {(each.route, each.topic, target.label): target for each in program.routes for target in each.targets}


def _without_detail(event: Event) -> Event:
    return replace(event, detail="") if isinstance(event, (Dropped, Rejected)) else event


def _fate(event: Event) -> str:
    name = type(event).__name__
    return f"{name} {event.reason}" if isinstance(event, (Dropped, Rejected)) else name


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=100_000, help="messages in all")
    parser.add_argument("--seed", type=int, default=1, help="of the first table; the others' follow")
    parser.add_argument("--findings", type=int, default=1, help="end after so many")
    args = parser.parse_args()
    definitions, fates = Definitions(), Counter[str]()
    done, seed, findings = 0, args.seed, 0
    with TemporaryDirectory() as folder:
        while done < args.count and findings < args.findings:
            judge = Judge(Path(folder), definitions, seed)
            if found := judge.run(STEPS):
                print(f"{judge.history}\n\nseed {seed}, step {judge.steps}: {found}\n")
                findings += 1
            done += judge.steps
            seed += 1
            fates += judge.fates
    print(f"{done} messages, {seed - args.seed} tables, {findings} differ: {dict(fates.most_common())}")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
