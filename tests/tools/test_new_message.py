"""`router new` writes a message as a person would: everywhere it belongs, and nothing of what cannot be."""

from __future__ import annotations

import difflib
import re
import shlex
import shutil
from pathlib import Path

import pytest

import router.assets
import router.cli.new
from router.assets import asset
from router.cli import BAD_TABLE, BAD_USAGE, INTERRUPTED, OK, main
from router.compiler import Checked

RADIATION = ("SensorBoardRadiationInfo", "--number", "27", "--board", "sensor")
FIELDS = ("--fields", "dose_rate:float # microsievert per hour", "state:SensorState status:SensorStatus")
ROUTE = """\
  radiation_info: {source: sensor_board, destinations: basestation, topic: radiation_info}

"""
TEST = """\
  radiation info reaches the operator and ROS as it is:
    given:
      case: radiation_info
      from: sensor_board
      fields: {dose_rate: 1.5, state: SENSOR_OPERATING, status: STATUS_OK}
    expect:
      sent: basestation
      published: {radiation_info: unchanged}

"""
DEFAULTS = "defaults: {package: comms}\n\n"
PAGE = Path(__file__).parents[2] / "docs" / "guides" / "add-a-message.md"
SITE = Path(__file__).parent / "new_message_site"
LOCK = "protos/envelope.lock.json"
ENVELOPE = "protos/components/common/envelope.proto"
RADIATION_PROTO = "protos/components/sensor_board/radiation.proto"
Files = dict[str, str]


@pytest.fixture(scope="module")
def small_rover(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small rover with everything that a new message touches. Not the rover itself: that may have a radiation sensor
    some day.
    """
    folder = tmp_path_factory.mktemp("small") / "rover"
    shutil.copytree(SITE, folder)
    for schema in asset("schemas").glob("*.json"):
        shutil.copy(schema, folder / "schemas")
    return folder


def work_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(router.assets, "_PLACES", (folder,))
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def site(small_rover: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the small rover, in which the router then works."""
    return work_in(shutil.copytree(small_rover, tmp_path, dirs_exist_ok=True), monkeypatch)


def rewrite(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def assert_clean() -> None:
    assert main(["validate", "--strict", "routes"]) == OK
    assert main(["test", "routes"]) == OK


def contents(site: Path) -> Files:
    return {str(path.relative_to(site)): path.read_text(encoding="utf-8") for path in site.rglob("*") if path.is_file()}


def added(before: Files, after: Files) -> dict[str, list[str]]:
    """The lines that each file has more; asserts that none is gone."""
    found = {}
    for name, text in after.items():
        lines = list(difflib.ndiff(before.get(name, "").splitlines(), text.splitlines()))
        if name != LOCK:
            assert [line for line in lines if line.startswith("- ")] == []
        if new := [line[2:] for line in lines if line.startswith("+ ")]:
            found[name] = new
    return found


def test_everything_that_has_to_know_of_it_is_written_and_nothing_else_changes(site: Path) -> None:
    before = contents(site)
    assert main(["new", *RADIATION, *FIELDS]) == OK
    new = added(before, contents(site))
    lock = new.pop(LOCK)
    assert '        "27": "oneof payload: SensorBoardRadiationInfo radiation_info"' in lock
    assert new.pop(RADIATION_PROTO) == [
        "// Radiation info from the sensor board.",
        'syntax = "proto3";',
        "",
        'import "components/sensor_board/sensor.proto";',
        "",
        "message SensorBoardRadiationInfo {",
        "  float dose_rate = 1;   // microsievert per hour",
        "  SensorState state = 2;",
        "  SensorStatus status = 3;",
        "}",
    ]
    assert new.pop(ENVELOPE) == [
        'import "components/sensor_board/radiation.proto";',
        "",
        "    // sensor board",
        "    SensorBoardRadiationInfo radiation_info = 27;",
    ]
    assert new.pop("schemas/comms/msg/SensorBoardRadiationInfo.msg") == [
        "# Radiation info from the sensor board.",
        "",
        "uint8 STATUS_UNKNOWN=0",
        "uint8 STATUS_OK=1",
        "uint8 STATUS_ERROR=2",
        "uint8 STATUS_DISCONNECTED=3",
        "uint8 STATUS_INITIALIZING=4",
        "",
        "float32 dose_rate   # microsievert per hour",
        "SensorState state",
        "uint8 status        # STATUS_*",
    ]
    assert new.pop("routes/rover.yaml") == ROUTE.splitlines()
    assert new.pop("routes/rover.test.yaml") == TEST.splitlines()
    assert new.pop("routes/legacy.yaml") == ["  radiation_info: {source: any, destinations: [dst_a, dst_b]}"]
    assert new == {}
    locked = contents(site)[LOCK]
    assert_clean()
    assert main(["schema", "lock", "--protos", "protos"]) == OK
    assert contents(site)[LOCK] == locked


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


def test_a_second_one_of_the_board_stands_beside_the_first(site: Path) -> None:
    assert main(["new", *RADIATION]) == OK
    before = contents(site)
    assert main(["new", "SensorBoardDustInfo", "--number", "28", "--board", "sensor_board"]) == OK
    envelope = added(before, contents(site))[ENVELOPE]
    assert envelope == ['import "components/sensor_board/dust.proto";', "    SensorBoardDustInfo dust_info = 28;"]


def test_without_fields_it_has_a_number_and_what_most_messages_of_the_board_have(site: Path) -> None:
    assert main(["new", *RADIATION]) == OK
    assert "{\n  float value = 1;\n  SensorState state = 2;\n}\n" in contents(site)[RADIATION_PROTO]


def test_what_the_basestation_sends_goes_to_ros_alone(site: Path) -> None:
    before = contents(site)
    assert main(["new", "BasestationHorn", "--number", "29", "--board", "basestation", "--fields", "is_on:bool"]) == OK
    assert added(before, contents(site))["routes/rover.yaml"] == [
        "",
        "  horn: {source: basestation, topic: horn}",
    ]


def test_without_a_package_for_all_topics_the_route_says_its_type(site: Path) -> None:
    rewrite(site / "routes/rover.yaml", DEFAULTS, "")
    assert main(["new", *RADIATION]) == OK
    text = (site / "routes/rover.yaml").read_text(encoding="utf-8")
    assert "topics: {topic: radiation_info, type: comms/msg/SensorBoardRadiationInfo}" in text
    assert_clean()


def test_a_board_without_routes_gets_a_section_at_the_end(site: Path) -> None:
    before = contents(site)
    assert main(["new", "ContainerBoardLid", "--number", "31", "--board", "container"]) == OK
    lines = added(before, contents(site))["routes/rover.yaml"]
    assert lines[1].startswith("  # ---- container board ----")
    assert lines[3] == "  lid: {source: container_board, destinations: basestation, topic: lid}"
    assert_clean()


def test_long_names_do_not_make_long_lines(site: Path) -> None:
    name = "DrivingBoardWheelSlipAndWhateverElseThereIsToKnow"
    fields = ("--fields", "left:MotorInformation right:MotorInformation")
    assert main(["new", name, "--number", "27", "--board", "driving", *fields]) == OK
    assert_clean()
    after = contents(site)
    lines = [*after["routes/rover.yaml"].splitlines(), *after["routes/rover.test.yaml"].splitlines()]
    assert max(map(len, lines)) <= 120


def test_a_table_beside_that_routes_in_its_own_way_is_left_to_a_person(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    legacy = (site / "routes/legacy.yaml").read_text(encoding="utf-8")
    (site / "routes/own.yaml").write_text(legacy.replace("[dst_a, dst_b]", "[dst_a]", 1), encoding="utf-8")
    before = contents(site)
    assert main(["new", *RADIATION]) == OK
    assert "routes/own.yaml" not in added(before, contents(site))
    said = capsys.readouterr()
    assert "route it yourself in routes/own.yaml" in said.out
    assert "no route for the payload case radiation_info" in said.err


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ("SensorBoardRadiationInfo 26 sensor", "number 26 belongs to 'manual_brake', for ever\nhelp: 27 is free"),
        ("SensorBoardRadiationInfo 30 sensor", "says: Number 30 is promised"),
        ("SensorBoardRadiationInfo 0 sensor", "0 is no field number of protobuf\nhelp: 27 is free"),
        ("SensorBoardRadiationInfo 19500 sensor", "19500 is no field number of protobuf"),
        ("SensorBoardRadiationInfo 27 sensors", "has no board 'sensors'\nhelp: did you mean 'sensor'?"),
        ("DoseInfo 27 sensor", "write it as SensorBoardDoseInfo"),
        ("SensorBoarddose 27 sensor", "write it as SensorBoardDose"),
        ("dose_info 27 sensor", "of sensor_board\nhelp: write it as SensorBoardRadiationInfo"),
        ("SensorBoardPumpInfo 27 sensor", "there is a message 'SensorBoardPumpInfo' already"),
        ("SensorBoardManualBrake 27 sensor", "has a payload case 'manual_brake' already, number 26"),
        ("SensorBoardWantedControlMode 27 sensor", "has a topic 'wanted_control_mode' already"),
        ("SensorBoardImuSensorInfo 27 sensor", "imu_sensor.proto already"),
        ("SensorBoardSwitch 27 sensor", "'switch' is a word of C or C++"),
        ("SensorBoardNull 27 sensor", "'null' is no text to readers of YAML"),
        ("SensorBoardDose 27 sensor dose", "'dose' is no field\nhelp: write name:type"),
        ("SensorBoardDose 27 sensor dose:flot", "did you mean 'float'?"),
        (
            "SensorBoardDose 27 sensor dose:string",
            "there is no type 'string' for 'dose'\nhelp: there are bool, float, double,",
        ),
        ("SensorBoardDose 27 sensor Dose:float", "'Dose' is no name of a field"),
        ("SensorBoardDose 27 sensor from:float", "'from' is no name of a field"),
        ("SensorBoardDose 27 sensor on:bool", "take another name"),
        ("SensorBoardDose 27 sensor a:bool b:bool # both", "belongs to one field"),
        ("SensorBoardDose 27 sensor a:bool a:float", "there are 2 fields 'a'"),
        ("SensorBoardDose 27 sensor double:float", "'double' is a word of C or C++"),
        ("SensorBoardDose 27 sensor  ", "--fields names no field"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(
    small_rover: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], asked: str, why: str
) -> None:
    before = contents(work_in(small_rover, monkeypatch))
    name, number, board, *fields = asked.split(" ", 3)
    words = ["--number", number, "--board", board, *(["--fields", *fields] if fields else [])]
    assert main(["new", name, *words]) == BAD_USAGE
    assert why in capsys.readouterr().err
    assert contents(small_rover) == before


def test_a_type_that_several_messages_have_is_to_be_said_whose(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("Left", "Right"):
        text = f'syntax = "proto3";\nmessage {name} {{\n  enum Side {{ {name.upper()} = 0; }}\n}}\n'
        (site / f"protos/{name.lower()}.proto").write_text(text, encoding="utf-8")
    assert main(["new", *RADIATION, "--fields", "side:Side"]) == BAD_USAGE
    assert (
        "several types are called 'Side'\nhelp: write which for 'side': Left.Side, Right.Side"
        in capsys.readouterr().err
    )
    assert main(["new", *RADIATION, "--fields", "side:Left.Side"]) == OK


def test_the_type_of_a_field_may_be_in_a_file_that_nothing_imports_yet(site: Path) -> None:
    proto = site / "protos/components/sensor_board/radiation_level.proto"
    proto.write_text('syntax = "proto3";\nenum RadiationLevel { RADIATION_UNKNOWN = 0; }\n', encoding="utf-8")
    assert main(["validate", "--strict", "routes/rover.yaml"]) == OK
    assert main(["new", *RADIATION, "--fields", "level:RadiationLevel"]) == OK
    after = contents(site)
    assert 'import "components/sensor_board/radiation_level.proto";' in after[RADIATION_PROTO]
    assert '"RADIATION_UNKNOWN"' in after[LOCK]


def test_a_type_in_a_file_with_a_fault_is_missed_with_the_fault(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    proto = site / "protos/radiation_level.proto"
    proto.write_text('syntax = "proto3";\nenum RadiationLevel { SENSOR_IDLE = 0; }\n', encoding="utf-8")
    assert main(["new", *RADIATION, "--fields", "level:RadiationLevel"]) == BAD_USAGE
    said = capsys.readouterr().err
    assert "there is no type 'RadiationLevel' for 'level'" in said
    assert "radiation_level.proto:2:23: warning[unused-proto]" in said


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
    rewrite(path, 'import "', 'import  "')
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
    before = contents(site)
    fields = " ".join(f"a_quite_long_name_{number}:{kind}" for number in range(6))
    assert main(["new", *RADIATION, "--fields", fields]) == OK
    lines = [line for line in added(before, contents(site))["routes/rover.test.yaml"] if "quite" in line]
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


def test_a_number_that_was_given_out_once_stays_taken(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    was = '"26": "oneof payload: BasestationManualBrake manual_brake"'
    rewrite(site / LOCK, was, f'{was},\n        "27": "Gone gone_info"')
    rewrite(site / ENVELOPE, "  oneof payload {", "  reserved 27;\n  oneof payload {")
    assert main(["new", *RADIATION]) == BAD_USAGE
    assert "number 27 belongs to 'gone_info', for ever\nhelp: 28 is free" in capsys.readouterr().err
    assert main(["new", "SensorBoardGoneInfo", "--number", "28", "--board", "sensor"]) == BAD_USAGE
    assert "'gone_info' had number 27 once" in capsys.readouterr().err


def test_what_turns_out_wrong_is_taken_back(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (site / "protos/odd.proto").write_text('syntax = "proto3";\nmessage Odd { float x = 1; }\n', encoding="utf-8")
    (site / "schemas/comms/msg/Odd.msg").write_text("string x\n", encoding="utf-8")
    before = contents(site)
    assert main(["new", *RADIATION, "--fields", "odd:Odd"]) == BAD_TABLE
    said = capsys.readouterr().err
    assert "error[" in said
    assert "nothing was written" in said
    assert contents(site) == before


def test_a_table_with_errors_is_repaired_first(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rewrite(site / "routes/rover.yaml", "type: comms/msg/SensorBoardPumpInfo", "type: comms/msg/SensorBoardPumpInf")
    before = contents(site)
    assert main(["new", *RADIATION]) == BAD_TABLE
    assert "repair that first" in capsys.readouterr().err
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


def test_a_table_elsewhere_gets_no_message_in_the_schemas_of_the_router(
    site: Path, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    project = tmp_path_factory.mktemp("project")
    for part in ("routes", "protos"):
        shutil.copytree(site / part, project / part)
    before = contents(site)
    assert main(["new", *RADIATION, "-t", str(project / "routes/rover.yaml")]) == BAD_USAGE
    assert f"(schemas) do not belong to {project / 'routes/rover.yaml'}" in capsys.readouterr().err
    assert contents(site) == before


def test_a_table_without_routes_of_its_own_names_the_one_that_it_extends(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (site / "routes/sim.yaml").write_text("version: 1\nextends: rover.yaml\n", encoding="utf-8")
    before = contents(site)
    assert main(["new", *RADIATION, "-t", "routes/sim.yaml"]) == BAD_USAGE
    assert "has no routes of its own\nhelp: take what it extends: -t routes/rover.yaml\n" in capsys.readouterr().err
    assert contents(site) == before


def test_where_there_is_no_table_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", *RADIATION]) == BAD_USAGE
    assert "there is no routes/rover.yaml here" in capsys.readouterr().err
    assert main(["new", *RADIATION, "-t", "routes/rover.yaml"]) == BAD_TABLE
    assert "nothing was written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_lock_may_be_elsewhere(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lock = (site / LOCK).rename(site / "wire.lock.json")
    for table in (site / "routes/rover.yaml", site / "routes/legacy.yaml"):
        rewrite(table, "oneof: payload", "oneof: payload, lock: ../wire.lock.json")
    assert main(["new", *RADIATION]) == OK
    assert "changed  wire.lock.json" in capsys.readouterr().out
    assert '"27": "oneof payload: SensorBoardRadiationInfo radiation_info"' in lock.read_text(encoding="utf-8")
    assert not (site / LOCK).exists()
