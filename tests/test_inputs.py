"""Everything that a compile reads is recorded, and every later change of it is detected."""

from __future__ import annotations

import argparse
import ast
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from router import inputs
from router.cli import main
from router.cli.tool_options import named_table, table_path
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.lookup import Definitions
from router.errors import StartError
from router.ros.arguments import Variables, ros_parameters, table_variables

if TYPE_CHECKING:
    from router.inputs import Plain

ROUTER = Path(inputs.__file__).parent

PROTO = """syntax = "proto3";
message Envelope { oneof payload { Reading reading = 1; } }
message Reading { string name = 1; int32 value = 2; }
"""
BASE = """version: 1
envelope: {protos: ../protos, message: Envelope, oneof: payload}
listen: {wifi: {address: "127.0.0.1:${PORT:-5000}", framing: exact}}
"""
TABLE = """extends: base.yaml
endpoints:
  board: {address: 127.0.0.2:8, kind: board}
  station: {address: 127.0.0.3:9, kind: basestation}
routes:
  reading: {source: board, destinations: station, topic: {topic: reading, type: our_msgs/msg/Reading}}
"""
NO_TABLE = argparse.Namespace(table=None, subject=None)
"""A command line without a table."""

MSG = "string name\nint32 value\n"


def put(path: str, text: str) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, with a table, protos, options, and the prefixes of two workspaces, one of them empty."""
    inputs._process.cache_clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/over{os.pathsep}{tmp_path}/under")
    monkeypatch.delenv("PORT", raising=False)
    put("routes/base.yaml", BASE)
    put("routes/rover.yaml", TABLE)
    put("protos/envelope.proto", PROTO)
    put("protos/envelope.options", "Reading.name max_size:16\n")
    put("protos/.git/HEAD", "ref: refs/heads/main\n")
    put("under/share/our_msgs/msg/Reading.msg", MSG)
    yield tmp_path
    inputs._process.cache_clear()


def compiled(known: CompiledTable | None = None) -> tuple[CompiledTable, Plain]:
    with inputs.recording() as read:
        definitions = Definitions(known.envelopes.schemas if known else ())
        checked = check_table(Path("routes/rover.yaml"), None, definitions)
        program = checked.program
    assert program is not None, "\n".join(map(str, checked.diagnostics))
    return program, read.plain()


def changed_in_new_process(plain: Plain) -> str:
    """The changes that a new process finds, which checks the installation afresh."""
    inputs._process.cache_clear()
    return inputs.changed(plain)


def pipe_instead() -> None:
    Path("routes/base.yaml").unlink()
    os.mkfifo("routes/base.yaml")


def folder_instead() -> None:
    Path("routes/base.yaml").unlink()
    Path("routes/base.yaml").mkdir()


def link_elsewhere() -> None:
    Path("protos").rename("others")
    Path("protos").symlink_to("others")


EDITS: dict[str, tuple[Callable[[], object], str]] = {
    "the table": (lambda: put("routes/rover.yaml", f"{TABLE}\n# a comment\n"), "routes/rover.yaml"),
    "a table that is extended": (lambda: put("routes/base.yaml", BASE.replace("5000", "5001")), "routes/base.yaml"),
    "a comment in a proto": (lambda: put("protos/envelope.proto", f"// a comment\n{PROTO}"), "envelope.proto"),
    "a new proto": (lambda: put("protos/new.proto", 'syntax = "proto3";\n'), "protos"),
    "a new proto in a new folder": (lambda: put("protos/inner/new.proto", 'syntax = "proto3";\n'), "protos"),
    "a proto that is gone": (lambda: Path("protos/envelope.proto").unlink(), "envelope.proto"),
    "options": (lambda: put("protos/envelope.options", "Reading.name max_size:17\n"), "envelope.options"),
    "options that are gone": (lambda: Path("protos/envelope.options").unlink(), "envelope.options"),
    "a lock that appears": (lambda: put("protos/envelope.lock.json", "{}"), "envelope.lock.json"),
    "a definition": (lambda: put("under/share/our_msgs/msg/Reading.msg", f"# more\n{MSG}"), "Reading.msg"),
    "a definition before another": (lambda: put("over/share/our_msgs/msg/Reading.msg", MSG), "over/share"),
    "a link to the same files": (link_elsewhere, "protos"),
    "a variable": (lambda: os.environ.update(PORT="5001"), "PORT"),
    "a variable that is empty": (lambda: os.environ.update(PORT=""), "PORT"),
    "the search path": (lambda: os.environ.update(AMENT_PREFIX_PATH=f"{Path.cwd()}/under"), "a variable of ROS"),
    "a variable of ROS": (lambda: os.environ.update(ROS_DISTRO="kilted"), "a variable of ROS"),
    "another middleware": (lambda: os.environ.update(RMW_IMPLEMENTATION="rmw_zenoh_cpp"), "a variable of ROS"),
    "a folder in place of a file": (folder_instead, "base.yaml"),
    "a pipe in place of a file": (
        pipe_instead,
        "base.yaml",
    ),
}


@pytest.fixture
def variables() -> Iterator[None]:
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.usefixtures("place", "variables")
def test_each_edit_between_two_starts_is_found(edit: str) -> None:
    _, plain = compiled()
    assert changed_in_new_process(plain) == ""
    make, named = EDITS[edit]
    make()
    assert named in changed_in_new_process(plain)


def rewrite(path: str, text: str) -> None:
    """Replace a file by one of the same size, as editors do."""
    assert len(text) == Path(path).stat().st_size
    put(f"{path}.new", text)
    Path(f"{path}.new").rename(path)


def restore(path: str, text: str) -> None:
    """Restore an earlier version with its time, like `cp -p` and rsync."""
    written = Path(path).stat().st_mtime_ns
    rewrite(path, text)
    os.utime(path, ns=(written, written))


def restore_in_place(path: str, text: str) -> None:
    written = Path(path).stat().st_mtime_ns
    Path(path).write_text(text, encoding="utf-8")
    os.utime(path, ns=(written, written))


def link_to(path: str, text: str) -> None:
    """Retarget a link to a file of the same size and time."""
    written = Path(path).stat().st_mtime_ns
    put("elsewhere/file", text)
    os.utime("elsewhere/file", ns=(written, written))
    Path(path).unlink()
    Path(path).symlink_to(Path("elsewhere/file").absolute())


def link_to_folder(path: str, text: str) -> None:
    """Retarget a link to a folder that has the same names."""
    folder = Path(path).parent
    shutil.copytree(folder, "elsewhere")
    restore_in_place(f"elsewhere/{Path(path).name}", text)
    folder.rename("before")
    folder.symlink_to(Path("elsewhere").absolute())


WAYS = [put, rewrite, restore, restore_in_place, link_to, link_to_folder]


@pytest.fixture
def settled(place: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, whose files count as written long ago."""
    monkeypatch.setattr(inputs, "_TICK", 0)
    time.sleep(0.02)  # more than a tick of the kernel
    return place


@pytest.mark.usefixtures("settled")
def test_files_that_were_written_long_ago_are_not_read_before_the_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    _, plain = compiled()
    monkeypatch.setattr(inputs, "open", None, raising=False)
    assert changed_in_new_process(plain) == ""


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("path", "before", "after"),
    [
        ("routes/base.yaml", BASE, BASE.replace("5000", "5001")),
        ("protos/envelope.proto", PROTO, PROTO.replace("value = 2", "value = 3")),
        ("under/share/our_msgs/msg/Reading.msg", MSG, MSG.replace("int32", "int64")),
    ],
)
def test_a_change_that_keeps_the_size_is_found(
    way: Callable[[str, str], None], path: str, before: str, after: str
) -> None:
    program, plain = compiled()
    way(path, after)
    assert changed_in_new_process(plain) != ""
    assert (compiled(program)[0].envelopes.first.schema is program.envelopes.first.schema) is ("protos" not in path)
    assert not inputs.are_same(compiled()[1], plain)
    if way is not link_to_folder:
        Path(path).unlink()
        put(path, before)
        assert changed_in_new_process(plain) == "", "the content is the same again"
        assert inputs.are_same(compiled()[1], plain)


HOUR = 3_600_000_000_000


@pytest.mark.parametrize(
    ("age", "second", "is_found"),
    [(HOUR, 1, False), (1, 1, True), (-HOUR, 1, True), (HOUR, 0, True)],
    ids=["written long ago", "just written", "a clock that was set back", "whole seconds"],
)
def test_contents_are_compared_where_times_do_not_tell(
    age: int, second: int, is_found: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = (time.time_ns() - age) // 1_000_000_000 * 1_000_000_000 + second
    monkeypatch.setattr(inputs, "_stamp", lambda _: (11, written, written, 1))
    table = tmp_path / "table.yaml"
    table.write_text("port: 5000\n")
    with inputs.noted() as read:
        inputs.read_text(table)
    table.write_text("port: 5001\n")
    assert (inputs.changed(read.plain()) != "") is is_found


@pytest.mark.usefixtures("place")
def test_a_package_that_is_installed_is_found(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packages = place / "lib/site-packages"
    packages.mkdir(parents=True)
    monkeypatch.setattr(sys, "path", [*sys.path, str(packages)])
    _, plain = compiled()
    assert changed_in_new_process(plain) == ""
    (packages / "our_msgs").mkdir()
    assert changed_in_new_process(plain) == "an installed package"


@pytest.mark.usefixtures("place")
def test_what_is_not_read_may_change() -> None:
    _, plain = compiled()
    os.utime("routes/rover.yaml")
    put("protos/.git/HEAD", "ref: refs/heads/other\n")
    put("protos/.envelope.proto.swp", "an editor's")
    put("routes/other.yaml", "version: 1\n")
    put("under/share/our_msgs/msg/Other.msg", MSG)
    assert changed_in_new_process(plain) == ""


@pytest.mark.usefixtures("place")
def test_a_hidden_proto_that_another_imports_is_noted_although_protoc_alone_reads_it() -> None:
    put("protos/.hidden/reading.proto", 'syntax = "proto3";\nmessage Other { int32 value = 1; }\n')
    put("protos/envelope.proto", PROTO.replace(";\n", ';\nimport public ".hidden/reading.proto";\n', 1))
    _, plain = compiled()
    put("protos/.hidden/reading.proto", 'syntax = "proto3";\nmessage Other { int64 value = 1; }\n')
    assert ".hidden/reading.proto" in inputs.changed(plain)


@pytest.mark.usefixtures("place")
def test_a_reload_that_takes_over_the_protos_notes_the_same_inputs_as_a_start() -> None:
    program, plain = compiled()
    again, after = compiled(program)
    assert again.envelopes.first.schema is program.envelopes.first.schema
    assert inputs.are_same(after, plain)


@pytest.mark.usefixtures("place")
def test_a_reload_compiles_the_protos_again_once_their_lock_has_changed() -> None:
    program, _ = compiled()
    assert main(["schema", "lock", "-t", "routes/rover.yaml"]) == 0
    again, after = compiled(program)
    assert again.envelopes.first.schema is not program.envelopes.first.schema
    assert inputs.are_same(after, compiled()[1])


@pytest.mark.usefixtures("place", "variables")
def test_the_table_of_the_command_line_and_the_ros_parameters_are_inputs(place: Path) -> None:
    put("params.yaml", "/**: {ros__parameters: {port: 5005}}")
    with inputs.recording() as asked:
        variables = Variables(table_variables(ros_parameters(["--params-file", "params.yaml"])), inputs.ENVIRONMENT)
        assert table_path(NO_TABLE) == Path("routes/rover.yaml")
    assert [variables.get(name) for name in ("PORT", "NOWHERE")] == ["5005", None]
    names = {name for _, name, *_ in asked.plain()}
    assert {f"{place}/params.yaml", f"{place}/routes/rover.yaml", "ROUTER_TABLE"} <= names
    assert "PORT" not in names, "a ROS parameter has set it"
    put("params.yaml", "/**: {ros__parameters: {port: 5006}}")
    assert "params.yaml" in inputs.changed(asked.plain())
    put("params.yaml", "/**: {ros__parameters: {port: 5005}}")
    os.environ["ROUTER_TABLE"] = "routes/base.yaml"
    assert "ROUTER_TABLE" in inputs.changed(asked.plain())
    assert named_table(NO_TABLE) == Path("routes/base.yaml")


@pytest.mark.usefixtures("place")
def test_a_recording_goes_on_from_an_earlier_one_and_has_what_is_noted_within() -> None:
    with inputs.recording() as before:
        inputs.read_text("routes/base.yaml")
    with inputs.recording(before) as read:
        with inputs.noted() as inner:
            inputs.is_file("routes/rover.yaml")
        inputs.ENVIRONMENT.get("PORT")
    inputs.is_file("protos")
    ours = [(kind, Path(name).name) for kind, name, *_ in read.plain() if kind in {"file", "variable"}]
    assert ours == [("file", "base.yaml"), ("file", "rover.yaml"), ("variable", "PORT")]
    assert [Path(name).name for _, name, *_ in inner.plain()] == ["rover.yaml"]


@pytest.mark.usefixtures("place")
def test_what_changed_while_it_was_read_is_never_the_same_again() -> None:
    with inputs.recording() as read:
        inputs.read_text("routes/base.yaml")
        put("routes/base.yaml", "version: 2\n")
        inputs.read_text("routes/base.yaml")
    assert "base.yaml" in inputs.changed(read.plain())
    put("routes/base.yaml", BASE)
    assert "base.yaml" in inputs.changed(read.plain())


@pytest.mark.usefixtures("place")
def test_a_pipe_is_neither_waited_for_nor_read_before_the_compile() -> None:
    with inputs.recording() as read:
        inputs.read_text("routes/base.yaml")
    reading, writing = os.pipe()
    os.write(writing, BASE.encode())
    [value] = [value for kind, _, value, _ in read.plain() if kind == "file"]
    assert inputs.changed((("file", f"/dev/fd/{reading}", value, None),)) == f"the file /dev/fd/{reading}"
    assert os.read(reading, 1000) == BASE.encode()
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize("edit", ["written", "restored", "new", "gone"])
def test_code_of_the_router_that_changed_is_found_by_the_next_process(
    edit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "router"
    put(f"{package}/cli/run.py", "pass")
    put(f"{package}/__init__.py", "pass")
    monkeypatch.setattr(inputs, "_PACKAGE", str(package))
    inputs._process.cache_clear()
    with inputs.recording() as read:
        pass
    put(f"{package}/cli/__pycache__/run.pyc", "compiled")
    assert changed_in_new_process(read.plain()) == ""
    if edit == "gone":
        (package / "cli/run.py").unlink()
    elif edit == "restored":
        restore(f"{package}/cli/run.py", "fail")
    else:
        put(f"{package}/cli/{'run' if edit == 'written' else 'new'}.py", "pass")
    assert inputs.changed(read.plain()) == "", "this process runs the code that it has imported"
    assert changed_in_new_process(read.plain()) == "the router's code"
    monkeypatch.undo()
    inputs._process.cache_clear()


_WATCHED = """
import json, os, sys
opened = []
def hook(event, arguments):
    if event in {"open", "os.listdir", "os.scandir"} and isinstance(arguments[0], (str, os.PathLike)):
        opened.append(os.path.abspath(arguments[0]))
from pathlib import Path
from router import inputs
from router.compiler import check_table
with inputs.recording() as read:
    sys.addaudithook(hook)
    checked = check_table(Path("routes/rover.yaml"))
    checked.program
found = list(opened)
print(json.dumps([found, [name for _, name, *_ in read.plain()], list(map(str, checked.diagnostics))]))
"""


def test_no_file_of_a_table_is_opened_that_is_not_noted(place: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    scratch = tmp_path_factory.mktemp("scratch")
    answer = subprocess.run(
        [sys.executable, "-c", _WATCHED],
        env={**os.environ, "TMPDIR": str(scratch)},
        stdout=subprocess.PIPE,
        check=True,
    )
    opened, names, findings = json.loads(answer.stdout)
    below = {path for path in opened if path.startswith(f"{place}/")}
    assert not [finding for finding in findings if "error" in finding]
    assert {f"{place}/routes/rover.yaml", f"{place}/protos/envelope.proto", f"{place}/protos"} <= below
    ignored = (
        str(scratch),
        f"{place}/everything",  # these are in the scratch folder, which is removed
        f"{place}/nanopb",
        sys.prefix,
        sys.base_prefix,
        str(ROUTER),
        "/proc",
        str(ROUTER.parent / "schemas" / "route"),
    )
    assert {path for path in opened if not path.startswith(ignored)} <= set(names)


_READING = {
    *("read_text", "read_bytes", "open", "is_file", "is_dir", "exists", "iterdir", "glob", "rglob", "stat", "lstat"),
    *("resolve", "readlink", "samefile", "is_symlink", "environ", "getenv", "listdir", "scandir", "realpath", "walk"),
    *("isfile", "isdir", "islink", "lexists", "access", "expanduser", "home", "from_file", "getmtime", "getsize"),
}
_ALLOWED = {
    "table/schema.py": ["read_text"],  # part of the code, and read once
    "compiler/zenoh_config.py": ["from_file"],  # table/build.py has read it
}


def test_the_language_reads_nothing_past_the_inputs() -> None:
    found: dict[str, list[str]] = {}
    for package in ("table", "types", "compiler"):
        for path in sorted((ROUTER / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if name := _read_by(node):
                    found.setdefault(path.relative_to(ROUTER).as_posix(), []).append(name)
    assert found == _ALLOWED


def _read_by(node: ast.AST) -> str:
    """The attribute or built-in function with which a node reads, or an empty text."""
    if isinstance(node, ast.Attribute) and node.attr in _READING:
        is_ours = isinstance(node.value, ast.Name) and node.value.id in {"inputs", "ast"}
        return "" if is_ours else node.attr
    return "open" if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "open" else ""


def test_a_lack_of_descriptors_is_not_a_mistake_in_a_file(place: Path) -> None:
    """As an OSError it would become a finding, and systemd would not start the router again."""
    table = Path("routes/rover.yaml")
    assert check_table(table, {}).program is not None
    allowed = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, allowed[1]))
    try:
        for read in (inputs.read_bytes, inputs.listing):
            with pytest.raises(StartError, match="cannot be read now: Too many open files"):
                read("routes" if read is inputs.listing else table)
        with pytest.raises(StartError, match=r"routes/rover.yaml cannot be read now: Too many open files"):
            check_table(table, {})
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, allowed)
