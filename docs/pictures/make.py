"""Take the pictures of README and documentation from the running program: `python -m docs.pictures.make [FOLDER]`.

Simulated rover, router and ROS nodes run in a network namespace of their own where one can be made. Each page is asked
for its text before it is taken, and the script fails where that is not what the picture is to show.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from rich.console import Console

from demo.children import Child
from demo.expected import checked_table, page_of
from demo.places import alone, free_ros_domain, taken_places
from router.errors import RouterError, TransportError
from router.table.model import RouteTable
from router.tools.running_router import health, metrics, url_of
from router.tools.top import Order, View, Window, view
from router.tools.top_view import Screen
from tests.gateway.browser import Browser, Page, executable

ROOT = Path(__file__).parents[2]
TABLE = Path("routes/sim.yaml")
DRAWN = Path("routes/rover.yaml")
BASESTATION = "basestation"
TOPIC = "/imu/data_raw"
FIELDS = ("linear_acceleration.x", "linear_acceleration.y", "angular_velocity.z")

DESKTOP = (1440, 900)
PHONE = (390, 844)
TERMINAL = (80, 36)
"""Columns and lines."""

NOTHING = 255
"""Palette index of transparent pixels, and the number of colours in a picture."""

SETTLED = 70.0
"""Seconds of normal traffic before a picture: pages show the last minute, and what came just before they opened."""

TAKING = 40.0
"""Seconds for the pictures of a healthy rover; then the basestation falls silent."""

SILENCE = 12.0
"""Least seconds of silence of the basestation in its picture."""

PATIENCE = 60.0
ATTEMPTS = 3

COMMANDED = 4.0
"""Seconds for which the talker commands the boards; later, a busy browser cannot make a command stale."""

WELL = r"all is well|nothing is wrong"
UNWELL = r"silent (for )?\d|connecting|no answer|does not get"
"""Patterns in the text of a page."""

_INSIDE = "ROUTER_PICTURES_INSIDE"


class PictureError(RouterError):
    """Raised if a picture would not show its subject."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Take the documentation's pictures from the running program.")
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "docs" / "pictures", help="where to")
    parser.add_argument("--settled", type=float, default=SETTLED, metavar="SECONDS", help="how long all flows before")
    args = parser.parse_args()
    folder = args.folder.resolve()
    os.chdir(ROOT)
    if _INSIDE not in os.environ and (wrapper := alone()):
        command = [sys.executable, "-m", "docs.pictures.make", str(folder), "--settled", str(args.settled)]
        return subprocess.run([*wrapper, *command], env=os.environ | {_INSIDE: "1"}, check=False).returncode
    try:
        make(folder, args.settled)
    except RouterError as error:
        print(f"pictures: {error}", file=sys.stderr)
        return 1
    return 0


def make(folder: Path, settled: float) -> None:
    """Write all pictures. Raises PictureError."""
    program = executable()
    if program is None:
        raise PictureError("there is no Chromium here (Debian: apt install chromium)")
    folder.mkdir(parents=True, exist_ok=True)
    _draw_routes(folder / "route-map.svg")
    table = checked_table(TABLE)
    if taken := taken_places(table):
        raise PictureError("\n  ".join([f"addresses of {TABLE} are taken:", *taken]))
    with tempfile.TemporaryDirectory() as scratch:
        profile = Path(scratch, "chromium")
        profile.mkdir()
        browser = Browser(program, profile)
        try:
            with rover(Path(scratch), table, settled + TAKING) as running:
                _take_all(folder, running, browser, settled)
        finally:
            browser.close()


def _draw_routes(file: Path) -> None:
    command = [sys.executable, "-m", "router", "graph", str(DRAWN), "-o", str(file)]
    drawn = subprocess.run(command, capture_output=True, text=True, check=False)
    if drawn.returncode:
        raise PictureError(drawn.stderr)
    _say(file, drawn.stderr.strip())


class Rover:
    """Router, simulator and ROS nodes."""

    def __init__(self, scratch: Path, table: RouteTable) -> None:
        self.url = url_of(table)
        self.gateway = f"http://{page_of(table)}/"
        self._running: list[Child] = []
        self._window = Window()
        self._env = os.environ | {
            "ROS_DOMAIN_ID": str(free_ros_domain()),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "RECORDINGS": str(scratch / "recordings"),
            "PYTHONUNBUFFERED": "1",
        }

    def start(self, name: str, *module: str) -> Child:
        child = Child(name, self._env, *module)
        self._running.append(child)
        return child

    def stop(self) -> None:
        for child in self._running:
            child.ask_to_end()
        for child in self._running:
            child.end()

    def look(self) -> View:
        self._window.add(metrics(self.url))
        return view(*self._window.ends, health(self.url).problems)

    def until(self, holds: Callable[[View], bool], what: str, patience: float = PATIENCE) -> View:
        limit = time.monotonic() + patience
        while True:
            for child in self._running:
                if child.exit_code is not None:
                    raise PictureError(f"the {child.name} has ended:\n{child.last_words()}")
            try:
                seen = self.look()
                if holds(seen):
                    return seen
            except TransportError:
                pass
            if time.monotonic() > limit:
                raise PictureError(f"not within {patience:.0f} s: {what}")
            time.sleep(0.5)

    def until_said(self, child: Child, what: str) -> None:
        """Wait until a child has printed a line."""
        self.until(lambda _: bool(child.latest), what)


@contextmanager
def rover(scratch: Path, table: RouteTable, well: float) -> Iterator[Rover]:
    """A rover whose basestation falls silent after this many seconds."""
    for attempt in range(ATTEMPTS):
        running = Rover(scratch, table)
        try:
            running.start("listener", "demo.ros_listener", str(TABLE))
            running.start("router", "router", "run", str(TABLE))
            talker = running.start("talker", "demo.ros_talker", str(TABLE))
            running.until_said(talker, "the router answers, and subscribes to topics")
            cut_off = f"{BASESTATION}:{well:g}-"
            simulator = running.start("simulator", "router", "sim", "-t", str(TABLE), "--json", "--silent", cut_off)
            running.until_said(simulator, "the simulator sends")
            talker.tell(str(time.monotonic() + COMMANDED))
            running.until(_flows, "all endpoints send, and topics have subscribers")
            time.sleep(COMMANDED)
            seen = running.look()
            if attempt + 1 < ATTEMPTS and any(row.lost for row in seen.routes):
                continue  # commands that were stale when ROS nodes found each other
            yield running
            return
        finally:
            running.stop()


def _take_all(folder: Path, running: Rover, browser: Browser, settled: float) -> None:
    desktop, phone = _page(browser, running.url, DESKTOP, "dark"), _page(browser, running.url, PHONE, "dark")
    query = f"topic={TOPIC}" + "".join(f"&plot={TOPIC}:{field}" for field in FIELDS)
    gateway = _page(browser, running.gateway, DESKTOP, "dark")
    gateway.call("Page.navigate", url=f"{running.gateway}?{query}")
    time.sleep(settled)
    top = running.until(_is_well, "everything is well")
    _write_terminal(folder / "top.svg", Screen(top, f"{TABLE.name} at {running.url}", Order.TABLE, TERMINAL[1]))

    said = _expect(desktop, wanted=WELL, unwanted=UNWELL)
    _expect(phone, wanted=WELL, unwanted=UNWELL)
    _write(folder / "status.png", _composed(browser, _shot(desktop), _shot(phone)), said)
    plotted, shown = re.escape(FIELDS[0]), "frame_id: imu_link"
    said = _expect(gateway, wanted=f"{plotted}.*{shown}|{shown}.*{plotted}", unwanted=r"connecting|choose a topic")
    _write(folder / "gateway.png", _shot(gateway), said)
    for page in (phone, gateway):
        page.close()

    desktop.prefer("light")
    running.until(_is_cut_off, "the basestation is silent, and deadmen send", PATIENCE + TAKING)
    said = _expect(desktop, wanted=rf"{BASESTATION}\b.{{0,40}}\bsilent", unwanted=r"connecting|no answer|does not get")
    _write(folder / "cut-off.png", _shot(desktop), said)


def _flows(seen: View) -> bool:
    """Return whether every endpoint that ever sends is heard, and subscribers receive the published topics."""
    heard = [age is not None and age < 2 for name, age in seen.silence.items() if name != "container_board"]
    topics = [target for row in seen.routes for target in row.targets if target.is_topic and row.rate]
    return bool(topics) and all(heard) and sum(target.rate > 0 for target in topics) > len(topics) / 2


def _is_well(seen: View) -> bool:
    return _flows(seen) and not any(row.is_tripped or row.is_losing for row in seen.routes) and not seen.silent


def _is_cut_off(seen: View) -> bool:
    silence = seen.silence.get(BASESTATION) or 0.0
    return seen.silent == (BASESTATION,) and silence > SILENCE and any(row.is_tripped for row in seen.routes)


def _page(browser: Browser, url: str, size: tuple[int, int], scheme: str) -> Page:
    page = browser.open(url, *size)
    page.prefer(scheme)
    page.call("Emulation.setScrollbarsHidden", hidden=True)
    return page


def _expect(page: Page, wanted: str, unwanted: str) -> str:
    """Return the page's text on one line, once it has the wanted texts and no unwanted ones."""
    limit = time.monotonic() + PATIENCE
    while True:
        text = " ".join(str(page.evaluate("document.body.innerText")).split())
        if re.search(wanted, text, re.IGNORECASE) and not re.search(unwanted, text, re.IGNORECASE):
            return text
        if time.monotonic() > limit:
            raise PictureError(f"the page does not say {wanted!r}, or says {unwanted!r}: {text}")
        time.sleep(0.2)


def _shot(page: Page) -> str:
    """A PNG in Base64."""
    return str(page.call("Page.captureScreenshot", format="png")["data"])


_COMPOSITION = """<!doctype html><style>
body {{ margin: 0; width: {width}px; height: {height}px; position: relative; }}
img {{ position: absolute; display: block; border: 1px solid #474d57; box-sizing: border-box; }}
.desktop {{ left: 0; top: 0; width: {desktop}px; border-radius: 10px; }}
.phone {{ right: 0; bottom: 0; width: {phone}px; border: 8px solid #000; outline: 1px solid #6b7280;
  border-radius: 36px; }}
</style>
<img class="desktop" src="data:image/png;base64,{wide}"><img class="phone" src="data:image/png;base64,{narrow}">"""


def _composed(browser: Browser, wide: str, narrow: str) -> str:
    """Return the desktop page with the phone page over its lower right corner, on a transparent background."""
    width, height = DESKTOP[0] + 120, DESKTOP[1] + 85
    html = _COMPOSITION.format(
        width=width, height=height, desktop=DESKTOP[0], phone=PHONE[0] * 0.84 + 16, wide=wide, narrow=narrow
    )
    page = browser.open("about:blank", width, height)
    page.call("Emulation.setDefaultBackgroundColorOverride", color={"r": 0, "g": 0, "b": 0, "a": 0})
    page.evaluate(f"document.documentElement.innerHTML = {json.dumps(html)}")
    page.until("[...document.images].length === 2 && [...document.images].every((image) => image.complete)")
    picture = _shot(page)
    page.close()
    return picture


def _write_terminal(file: Path, shown: Screen) -> None:
    """Write a terminal of size TERMINAL as SVG, without the web fonts that rich's own SVG loads."""
    columns, _ = TERMINAL
    with Path(os.devnull).open("w", encoding="utf-8") as nothing:
        console = Console(width=columns, record=True, file=nothing, force_terminal=True, color_system="truecolor")
        console.print(shown)
        said = console.export_text(clear=False)
        text = console.export_svg(title="router top")
    text = re.sub(r"@font-face \{.*?\}\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL).replace("Fira Code", "ui-monospace, DejaVu Sans Mono")
    file.write_text(text, encoding="utf-8")
    _say(file, said)


def _write(file: Path, picture: str, said: str) -> None:
    """Write a PNG of few colours, a third as large as the browser's. Keeps transparency."""
    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGBA")
    few = image.convert("RGB").quantize(NOTHING, kmeans=1, dither=Image.Dither.NONE)
    few.putpalette([*(few.getpalette() or ()), 0, 0, 0])
    few.paste(NOTHING, mask=image.getchannel("A").point(lambda alpha: 255 * (alpha < 128)))
    few.save(file, optimize=True, transparency=NOTHING)
    _say(file, f"{image.width}x{image.height}; {said}")


def _say(file: Path, text: str) -> None:
    """Print the picture's name and content on one line, truncated to the terminal's width."""
    line = f"{file.name}: {file.stat().st_size / 1000:.0f} kB; {' '.join(text.split())}"
    print(line[: shutil.get_terminal_size().columns - 1] if sys.stdout.isatty() else line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
