"""Kept programs in files: what is written is found, and whatever else lies there is not used, with a reason."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from router import inputs
from router.image.image import Image
from router.startup_image import store

IMAGE = bytes(range(256)) * 3
PARTS = {"listeners": [("wifi", 5000)], "deadmen": b"\0brake", "ratio": 0.5, "none": None}
VARIABLE = "A_VARIABLE_THAT_NOBODY_SETS"
UNCHANGED = (("variable", VARIABLE, (None,), None),)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of kept programs, and this process the command `router run`."""
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["router", "run"])
    return tmp_path / "rover-router"


def only(folder: Path) -> Path:
    [path] = folder.iterdir()
    return path


def keep(parts: object = PARTS, image: bytes = IMAGE) -> None:
    store.write(UNCHANGED, Image(names=parts, memory=image))


def refused() -> str:
    kept, reason = store.find()
    assert kept is None
    return reason


def test_what_is_written_is_found(cache: Path) -> None:
    assert store.find() == (None, "")
    keep()
    kept, reason = store.find()
    assert kept is not None
    assert reason == ""
    assert (kept.inputs, kept.image.parts()["names"], kept.image.memory) == (UNCHANGED, PARTS, IMAGE)
    assert (cache.stat().st_mode & 0o777, only(cache).stat().st_mode & 0o777) == (0o700, 0o600)


def test_a_program_without_an_image_is_kept_too() -> None:
    keep(image=b"")
    kept, _ = store.find()
    assert kept is not None
    assert kept.image.parts()["names"] == PARTS


def test_the_next_one_replaces_it(cache: Path) -> None:
    keep("first")
    keep("second")
    kept, _ = store.find()
    assert kept is not None
    assert kept.image.parts()["names"] == "second"
    only(cache)


def test_each_command_line_and_folder_has_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep("mine")
    monkeypatch.setattr(sys, "argv", ["router", "run", "other.yaml"])
    assert store.find() == (None, "")
    keep("other's")
    monkeypatch.setattr(sys, "argv", ["router", "run"])
    monkeypatch.chdir(tmp_path)
    assert store.find() == (None, "")


def test_one_whose_inputs_changed_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    keep()
    monkeypatch.setenv(VARIABLE, "5000")
    assert refused() == f"the variable {VARIABLE} has changed"


def test_no_flipped_bit_is_overlooked(cache: Path) -> None:
    keep()
    path = only(cache)
    whole = path.read_bytes()
    reasons = set()
    for at in range(len(whole)):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        reasons.add(refused())
    others = {"it is not a kept program", "it has another format", "it was written by another version of Python"}
    assert reasons == {"it is damaged", "it is truncated", *others}
    path.write_bytes(whole)
    assert store.find()[0] is not None


def test_a_truncated_one_is_not_used_whatever_its_length(cache: Path) -> None:
    keep()
    path = only(cache)
    for size in reversed(range(path.stat().st_size)):
        os.truncate(path, size)
        assert refused() == "it is truncated"
    path.write_bytes(b"")
    assert refused() == "it is truncated"


def test_one_with_something_behind_its_end_is_not_used(cache: Path) -> None:
    keep()
    with only(cache).open("ab") as stream:
        stream.write(b"\0")
    assert refused() == "it is damaged"


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def replace_by_link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def replace_by_text(path: Path) -> None:
    path.write_text("version: 1\n" * 99)


def replace_by_loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


FOREIGN: dict[str, tuple[Callable[[Path], None], str]] = {
    "a link": (replace_by_link, "it is a symbolic link"),
    "a link to itself": (replace_by_loop, "it is a symbolic link"),
    "a folder": (replace_by_folder, "it is not a regular file"),
    "a pipe": (replace_by_pipe, "it is not a regular file"),
    "writable by the group": (lambda path: path.chmod(0o660), "others may write to it"),
    "writable by all": (lambda path: path.chmod(0o602), "others may write to it"),
    "in a folder that all write to": (lambda path: path.parent.chmod(0o777), "others may write to its folder"),
    "a text": (replace_by_text, "it is not a kept program"),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_what_is_not_of_this_user_alone_is_not_used(kind: str, cache: Path) -> None:
    keep()
    make, reason = FOREIGN[kind]
    make(only(cache))
    assert refused() == reason


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_what_belongs_to_another_user_is_not_used(cache: Path) -> None:
    keep()
    os.chown(only(cache), 1000, -1)
    assert refused() == "it belongs to another user"
    os.chown(only(cache), 0, -1)
    os.chown(cache, 1000, -1)
    assert refused() == "its folder belongs to another user"
    with pytest.raises(PermissionError, match="another user"):
        keep()


def test_one_that_was_swapped_with_that_of_another_table_is_not_used(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep()
    mine = only(cache)
    monkeypatch.setattr(sys, "argv", ["router", "run", "other.yaml"])
    keep()
    [other] = set(cache.iterdir()) - {mine}
    other.rename(mine)
    monkeypatch.setattr(sys, "argv", ["router", "run"])
    assert refused() == "it belongs to another command line, folder or Python"


def test_one_of_another_python_or_format_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    keep()
    with monkeypatch.context() as another:
        another.setattr(sys, "hexversion", sys.hexversion + 1)
        assert refused() == "it was written by another version of Python"
    monkeypatch.setattr(store, "_FORMAT", 0)
    assert refused() == "it has another format"


@pytest.mark.parametrize("strange", [1, None, (("no such kind", "name", None),), (("file", 5, None, None),)])
def test_a_whole_file_with_other_content_is_refused_with_a_reason(
    strange: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It can only come of a bug; even that keeps no router from starting."""
    with monkeypatch.context() as unchecked:
        unchecked.setattr(inputs, "changed", lambda _: "")
        store.write(strange, Image(names=PARTS, memory=IMAGE))  # type: ignore[arg-type]
    assert "cannot be read" in refused()


def test_a_program_whose_inputs_changed_since_they_were_read_is_not_kept(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep("before")
    with monkeypatch.context() as changed:
        changed.setenv(VARIABLE, "5000")
        with pytest.raises(OSError, match="has changed meanwhile"):
            keep("after")
    kept, _ = store.find()
    assert kept is not None
    assert kept.image.parts()["names"] == "before"
    only(cache)


def test_one_that_no_router_has_started_with_is_tried_a_few_times_a_minute(cache: Path) -> None:
    why = f"the last {store._MOST_TRIES} starts that used it failed"

    def try_too_often() -> None:
        assert [store.count_try() for _ in range(store._MOST_TRIES + 2)] == [*[""] * store._MOST_TRIES, why, why]

    keep()
    path = only(cache)
    try_too_often()
    store.clear_tries()
    try_too_often()
    os.utime(f"{path}{store._TRIES}", (0, 0))
    try_too_often()
    keep()
    assert only(cache) == path


def test_where_nothing_can_be_written_tries_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/sys")
    assert {store.count_try() for _ in range(store._MOST_TRIES + 1)} == {""}


def test_at_most_four_are_kept_and_the_oldest_go(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths: list[Path] = []
    for number in range(6):
        monkeypatch.setattr(sys, "argv", ["router", "run", f"{number}.yaml"])
        keep()
        paths += set(cache.iterdir()) - {*paths}
        os.utime(paths[-1], (number, number))  # the clock of a computer that was just switched on
    assert set(cache.iterdir()) == set(paths[2:])
    assert store.find()[0] is not None


def test_a_file_that_is_removed_while_all_are_read_is_left_out(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep()
    oldest = only(cache)
    os.utime(oldest, (0, 0))
    monkeypatch.setattr(sys, "argv", ["router", "run", "other.yaml"])
    keep()
    found = store.list_files()
    assert next(found)[1] is not None
    oldest.unlink()
    assert list(found) == []


def test_what_another_process_is_writing_stays_and_what_one_has_left_goes(cache: Path) -> None:
    keep()
    young, old = cache / f"1.program.1-1{store._UNFINISHED}", cache / f"2.program.1-1{store._UNFINISHED}"
    young.write_bytes(b"half")
    old.write_bytes(b"half")
    os.utime(old, (0, 0))
    keep()
    assert young.exists()
    assert not old.exists()


_WRITER = """
import sys
sys.argv = ["router", "run"]
from router.image.image import Image
from router.startup_image import store
for number in range(200):
    image = Image(names=number, memory=bytes([number]) * 50_000)
    store.write((("variable", "A_VARIABLE_THAT_NOBODY_SETS", (None,), None),), image)
"""


def test_two_routers_that_write_at_once_leave_one_whole_file(cache: Path) -> None:
    keep()
    writers = [subprocess.Popen([sys.executable, "-c", _WRITER]) for _ in range(2)]
    found = 0
    while any(writer.poll() is None for writer in writers):
        kept, reason = store.find()
        assert kept is not None, reason
        assert len({*kept.image.memory}) == 1 or kept.image.parts()["names"] == PARTS
        found += 1
    assert [writer.returncode for writer in writers] == [0, 0]
    assert found
    only(cache)


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_failed_write_leaves_what_was_kept(cache: Path) -> None:
    keep("before")
    with largest_file(1000), pytest.raises(OSError, match="large") as caught:
        keep("after", bytes(100_000))
    assert caught.value.errno == errno.EFBIG
    kept, _ = store.find()
    assert kept is not None
    assert kept.image.parts()["names"] == "before"
    only(cache)


_WITHOUT_ROOM = """
import os, sys
sys.argv = ["router", "run"]
from router.image.image import Image
from router.startup_image import store
unchanged = (("variable", "A_VARIABLE_THAT_NOBODY_SETS", (None,), None),)
store.write(unchanged, Image(names="before"))
REMOUNT
try:
    store.write(unchanged, Image(memory=bytes(100_000)))
except OSError as error:
    print(error.strerror, store.find()[0].image.names, len(os.listdir(os.environ["XDG_CACHE_HOME"] + "/rover-router")))
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount")
@pytest.mark.parametrize(
    ("remount", "why"),
    [("", "No space left on device"), ("os.system('mount -o remount,ro kept')", "Read-only file system")],
)
def test_a_disk_that_is_full_or_read_only_is_an_error_that_leaves_what_was_kept(
    remount: str, why: str, tmp_path: Path
) -> None:
    small_disk = 'mount -t tmpfs -o size=64k kept "$XDG_CACHE_HOME" && exec "$0" -c "$1"'
    command = ["unshare", "--mount", "sh", "-c", small_disk, sys.executable, _WITHOUT_ROOM.replace("REMOUNT", remount)]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if "permission denied" in answer.stderr:
        pytest.skip("nothing can be mounted here")
    assert answer.stdout == f"{why} before 1\n", answer.stderr


def test_a_file_where_the_folder_belongs_is_an_error(cache: Path) -> None:
    cache.write_text("")
    assert "cannot be read" in refused()
    with pytest.raises(OSError, match="exists"):
        keep()


@pytest.mark.parametrize(
    ("variables", "folder"),
    [
        ({"STATE_DIRECTORY": "/var/lib/rover:/var/lib/other", "XDG_CACHE_HOME": "/c"}, "/var/lib/rover/kept"),
        ({"XDG_CACHE_HOME": "/c", "HOME": "/home/rover"}, "/c/rover-router"),
        ({"XDG_CACHE_HOME": "relative", "HOME": "/home/rover"}, "/home/rover/.cache/rover-router"),
        ({"XDG_CACHE_HOME": "", "HOME": "/home/rover"}, "/home/rover/.cache/rover-router"),
    ],
)
def test_the_service_keeps_them_in_its_state_and_users_in_their_cache(
    variables: dict[str, str], folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert store.folder() == folder


def test_without_a_place_nothing_is_found_and_nothing_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", "nowhere")
    assert store.find() == (None, "")
    with pytest.raises(OSError, match="HOME"):
        keep()


def test_a_changed_input_is_found_in_a_recording_that_was_written(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    table.write_text("version: 1\n")
    with inputs.recording() as read:
        inputs.read_text(table)
    store.write(read.plain(), Image(names=PARTS, memory=IMAGE))
    kept, _ = store.find()
    assert kept is not None
    assert kept.inputs == read.plain()
    table.write_text("version: 2\n")
    assert refused() == f"the file {table} has changed"


_SMALL = """\
import sys
before = set(sys.modules)
import router.startup_image.store
print(*sorted(set(sys.modules) - before))
"""


def test_it_imports_small_modules_alone() -> None:
    """`-S`, because site and what it loads come before the router in any case."""
    answer = subprocess.run(
        [sys.executable, "-S", "-c", _SMALL],
        env={**os.environ, "PYTHONPATH": str(Path(inputs.__file__).parents[1])},
        capture_output=True,
        text=True,
        check=True,
    )
    ours = {name for name in answer.stdout.split() if name.partition(".")[0] == "router"}
    assert ours == {
        "router", "router.image", "router.image.image", "router.inputs", "router.startup_image",
        "router.startup_image.store",
    }  # fmt: skip
    heavy = {"pathlib", "re", "dataclasses", "inspect", "typing", "logging", "json", "hashlib", "argparse", "tempfile"}
    assert not heavy & set(answer.stdout.split())
