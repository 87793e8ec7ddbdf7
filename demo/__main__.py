"""`python -m demo`: simulated rover, router and real ROS nodes for some seconds; exit 0 when everything arrived.

At first operator and software both command the boards, then the operator alone. In the middle the basestation is cut
off, and a deadman has to halt the rover.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.table import Table
from rich.text import Text

from demo.expected import checked_table, page_of
from demo.places import taken_places
from demo.processes import TABLE, Demo, DemoError
from demo.verdict import Finding
from router.errors import RouterError
from router.table.addresses import Address
from router.table.model import RouteTable

ROOT = Path(__file__).parent.parent
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

SUCCESS = "It works: boards, basestation and ROS 2 nodes exchanged messages, and a lost link stopped the rover."
NEXT_STEPS = """\
Where to look next:
  routes/rover.yaml                      the rover's table
  .venv/bin/router validate routes/      checks it before you drive
  .venv/bin/router explain imu_info      shows how one message is routed
  .venv/bin/router demo                  runs boards and router, until Ctrl-C"""


def leave(number: int, frame: FrameType | None) -> None:
    """Signal handler that ends the demo through its `finally`."""
    raise SystemExit(128 + number)


def play(console: Console, table: RouteTable) -> list[Finding]:
    """Run the demo. Raises DemoError."""
    if problems := taken_places(table):
        told = "\n  ".join(problems)
        raise DemoError(f"addresses of {TABLE} are in use: stop the other demo, router or simulator\n  {told}")
    demo = Demo(table)
    try:
        return demo.run(console)
    finally:
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)  # do not interrupt the cleanup
        demo.end()


def tell(console: Console, findings: list[Finding], pages: Mapping[str, Address | None]) -> int:
    """Print the verdict and return the exit code. `pages` maps what a page shows to its address."""
    verdicts = Table.grid(padding=(0, 2))
    for finding in findings:
        mark = Text("ok", style="green") if finding.ok else Text("FAIL", style="red")
        verdicts.add_row(mark, Text(finding.text))
    console.print(verdicts)
    if all(finding.ok for finding in findings):
        console.print(f"\n{SUCCESS}\n", style="bold")
        console.print(NEXT_STEPS, highlight=False)
        for shows, page in pages.items():
            if page is not None:
                console.print(f"  {f'http://{page}/':<37}  {shows}, while `router demo` runs", highlight=False)
        return 0
    console.print("\nThe demo failed: see the lines above.", style="bold red")
    return 1


def main() -> int:
    os.chdir(ROOT)
    for number in ENDING:
        signal.signal(number, leave)
    console = Console()
    console.print(f"Starting router, simulated rover and two ROS 2 nodes on {TABLE} ...", highlight=False)
    try:
        table = checked_table(TABLE)
        findings = play(console, table)
    except RouterError as error:
        console.print(f"The demo cannot run: {error}", style="red", highlight=False, markup=False)
        return 1
    pages = {"status page": table.http.address.value if table.http else None, "ROS topics": page_of(table)}
    return tell(console, findings, pages)


if __name__ == "__main__":
    sys.exit(main())
