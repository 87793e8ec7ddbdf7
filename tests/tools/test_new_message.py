"""`router new` beside files of other layouts, and interrupted; tests/transcripts/new.md has what it writes."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

import router.assets
import router.cli.new
from router.cli import BAD_USAGE, INTERRUPTED, OK, main
from router.compiler import Checked

RADIATION = ("SensorBoardRadiationInfo", "--number", "27", "--board", "sensor")
ROUTE = """\
  radiation_info: {source: sensor_board, destinations: basestation, topic: radiation_info}

"""
PAGE = Path(__file__).parents[2] / "docs" / "guides" / "add-a-message.md"
SITE = Path(__file__).parent / "new_message_site"
ENVELOPE = "protos/components/common/envelope.proto"
Files = dict[str, str]


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small rover with everything that a new message touches, in which the router works. Not the rover itself: that
    may have a radiation sensor some day.
    """
    shutil.copytree(SITE, tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(router.assets, "_PLACES", (tmp_path, *router.assets._PLACES))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(site: Path) -> Files:
    return {str(path.relative_to(site)): path.read_text(encoding="utf-8") for path in site.rglob("*") if path.is_file()}


def test_the_page_about_it_shows_what_is_written(site: Path) -> None:
    page = PAGE.read_text(encoding="utf-8")
    command = re.search(r"^\$ router (new .*?[^\\])\n", page, re.DOTALL | re.MULTILINE)
    assert command is not None
    assert main(shlex.split(command[1].replace("\\\n>", " "))) == OK
    written = ["\n".join(map(str.strip, text.splitlines())) for text in contents(site).values()]
    shown = page.partition("## What it writes")[2].partition("## ")[0]
    blocks = re.findall(r"^ *```\w*\n(.*?)^ *```", shown, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 5
    for block in blocks:
        assert any("\n".join(map(str.strip, block.splitlines())) in text for text in written), block


def test_long_names_do_not_make_long_lines(site: Path) -> None:
    name = "DrivingBoardWheelSlipAndWhateverElseThereIsToKnow"
    fields = ("--fields", "left:MotorInformation right:MotorInformation")
    assert main(["new", name, "--number", "27", "--board", "driving", *fields]) == OK
    assert main(["validate", "--strict", "routes"]) == OK
    assert main(["test", "routes"]) == OK
    after = contents(site)
    lines = [*after["routes/rover.yaml"].splitlines(), *after["routes/rover.test.yaml"].splitlines()]
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize(
    "stanza",
    [
        "pump_info: {\n    source: sensor_board, destinations: [basestation],\n    topics: []\n  }\n",
        "pump_info: {source: sensor_board, topics: [\n  ], destinations: [basestation]\n}\n",
        "pump_info:\n  - source: sensor_board\n    destinations: [basestation]\n",
        (
            "pump_info:\n    source: sensor_board\n    destinations:\n      - endpoint: basestation\n"
            "        when: >-\n          enabled\n          or speed_rpm > 1\n"
        ),
    ],
)
def test_the_route_goes_below_one_that_is_laid_out_in_another_way(site: Path, stanza: str) -> None:
    path = site / "routes/rover.yaml"
    text = path.read_text(encoding="utf-8")
    start = text.index("pump_info:")
    end = text.index("  # ---- driving board", start)
    path.write_text(f"{text[:start]}{stanza}\n{text[end:]}", encoding="utf-8")
    (site / "routes/rover.test.yaml").unlink()
    assert main(["new", *RADIATION]) == OK
    assert f"{stanza}\n{ROUTE}" in path.read_text(encoding="utf-8")


def test_the_import_goes_where_imports_go(site: Path) -> None:
    path = site / ENVELOPE
    path.write_text(path.read_text(encoding="utf-8").replace('import "', 'import  "'), encoding="utf-8")
    assert main(["new", *RADIATION]) == OK
    lines = path.read_text(encoding="utf-8").splitlines()
    place = lines.index('import "components/sensor_board/radiation.proto";')
    assert lines[place - 1].startswith('import  "components/sensor_board/')


def test_files_keep_their_ends_of_lines(site: Path) -> None:
    files = [site / "routes/rover.yaml", site / "routes/rover.test.yaml", site / "routes/legacy.yaml"]
    for path in files:
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert main(["new", *RADIATION]) == OK
    for path in files:
        assert path.read_bytes().count(b"\n") == path.read_bytes().count(b"\r\n")
    assert main(["test", "routes"]) == OK


@pytest.mark.parametrize("kind", ["SensorState", "MotorInformation"])
def test_a_name_and_its_value_stay_on_one_line_of_the_test(site: Path, kind: str) -> None:
    fields = " ".join(f"a_quite_long_name_{number}:{kind}" for number in range(6))
    assert main(["new", *RADIATION, "--fields", fields]) == OK
    lines = [line for line in contents(site)["routes/rover.test.yaml"].splitlines() if "quite" in line]
    assert len(lines) > 1
    assert not any(line.endswith(":") for line in lines)


@pytest.mark.parametrize(
    ("error", "ending"),
    [(PermissionError(13, "Permission denied"), "rover.test.yaml"), (KeyboardInterrupt(), ".proto")],
)
def test_what_is_interrupted_is_taken_back(
    site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: BaseException, ending: str
) -> None:
    before, folders = contents(site), set(site.rglob("*"))
    really = Path.write_text

    def write_text(path: Path, *args: str, **kwargs: str) -> int:
        if path.name.endswith(ending) and path.resolve().is_relative_to(site):
            if isinstance(error, OSError):
                error.filename = str(path)
            raise error
        return really(path, *args, **kwargs)

    monkeypatch.setattr(Path, "write_text", write_text)
    words = ["new", "ContainerBoardRadiationInfo", "--number", "27", "--board", "container"]
    if isinstance(error, OSError):
        assert main(words) == BAD_USAGE
        assert "cannot be written: Permission denied" in capsys.readouterr().err
    else:
        assert main(words) == INTERRUPTED
    assert contents(site) == before
    assert set(site.rglob("*")) == folders


def test_a_file_in_the_place_of_a_folder_is_told_and_all_is_taken_back(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    in_the_way = site / "protos/components/container_board"
    in_the_way.touch()
    before, folders = contents(site), set(site.rglob("*"))
    assert main(["new", "ContainerBoardRadiationInfo", "--number", "27", "--board", "container"]) == BAD_USAGE
    assert f"{in_the_way} cannot be written: File exists" in capsys.readouterr().err
    assert (contents(site), set(site.rglob("*"))) == (before, folders)


def test_what_is_interrupted_while_it_is_checked_is_taken_back(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(site)
    really = router.cli.new._check

    def check(table: Path) -> list[Checked]:
        if contents(site) != before:
            raise KeyboardInterrupt
        return really(table)

    monkeypatch.setattr(router.cli.new, "_check", check)
    assert main(["new", *RADIATION]) == INTERRUPTED
    assert contents(site) == before


def test_an_installation_is_not_the_place_for_a_new_message(
    site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(router.assets, "_PACKAGE", site)
    before = contents(site)
    assert main(["new", *RADIATION]) == BAD_USAGE
    assert (
        "do not belong to routes/rover.yaml\nhelp: use the router of that table's checkout" in capsys.readouterr().err
    )
    assert contents(site) == before
