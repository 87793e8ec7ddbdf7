from __future__ import annotations

import io

from rich.console import Console

from router.tools.sim_view import SimView
from router.tools.simulator import Arrivals, Statistics
from router.tools.wire import Wire


def some_statistics(wire: Wire) -> Statistics:
    statistics = Statistics()
    statistics.sent["board", "every_kind"] = 7
    message = wire.case("every_kind").message_class(i32=5)
    statistics.received["station", "every_kind"] = Arrivals(message, 4)
    statistics.received["board", "plain"] = Arrivals(wire.case("plain").message_class(value=1.5), 2)
    return statistics


def shown(view: SimView, height: int) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=70).print(view.table(height))
    return [" ".join(line.split()) for line in out.getvalue().splitlines()]


def test_each_endpoint_and_case_has_a_line_with_its_last_value(wire: Wire) -> None:
    view = SimView(wire, some_statistics(wire))
    view.look(2.0)
    assert shown(view, 10) == [
        "endpoint received count /s last value",
        "board plain 2 1.0 value=1.5",
        "station every_kind 4 2.0 i32=5",
    ]
    assert shown(view, 2)[1:] == ["and 2 more"]


def test_rates_are_those_of_the_last_seconds(wire: Wire) -> None:
    statistics = some_statistics(wire)
    view = SimView(wire, statistics)
    for second in range(1, 10):
        view.look(float(second))
    statistics.received["board", "plain"].count += 6
    view.look(10.0)
    assert view.line() == "10 s: sent 7, came back 12; board 8 (2.0/s), station 4 (0/s)"


def test_silence_hints_at_a_missing_router(wire: Wire) -> None:
    view = SimView(wire, Statistics())
    view.look(5.0)
    assert view.headline() == "5 s: sent 0, came back 0 (is the router running with this table?)"
