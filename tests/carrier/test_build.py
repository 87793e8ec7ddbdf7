"""Building the library: by which compilers, when again, and what happens to one that is in use."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from router.carrier import build
from router.library import load

COMPILERS = [compiler for compiler in ("gcc", "clang") if shutil.which(compiler)]


@pytest.mark.parametrize("compiler", COMPILERS)
def test_compilers_have_nothing_to_warn_of_and_their_libraries_can_be_loaded(compiler: str, tmp_path: Path) -> None:
    flags = [*build.WARNINGS, *build._OPTIMIZED, *build._LINKED]
    load(build.build(tmp_path / "libcarrier.so", flags, compiler))


@pytest.fixture
def native(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder with the sources: here one that is compiled soon."""
    folder = tmp_path / "native"
    folder.mkdir()
    (folder / "one.h").write_text("extern const char *made_of;\n")
    (folder / "one.c").write_text('#include "one.h"\nconst char *made_of = CARRIER_CHECKSUM;\n')
    monkeypatch.setattr(build, "NATIVE", folder)
    return folder


@pytest.fixture
def made(native: Path) -> Path:
    return build.build(native / "libcarrier.so")


def test_a_library_is_current_until_a_source_changes(made: Path, native: Path) -> None:
    assert build.is_current(made)
    with (native / "one.h").open("a") as header:
        header.write("\n")
    assert not build.is_current(made)
    build.build(made)
    assert build.is_current(made)
    build.declared_by(made).unlink()  # what the headers declare
    assert not build.is_current(made)
    build.build(made)
    made.unlink()
    assert not build.is_current(made)


def test_a_library_that_is_loaded_keeps_its_file(made: Path, native: Path) -> None:
    before = set(native.iterdir())
    with made.open("rb") as loaded:
        inode = made.stat().st_ino
        build.build(made)
        assert Path(f"/proc/self/fd/{loaded.fileno()}").stat().st_ino == inode
        assert made.stat().st_ino != inode
    assert set(native.iterdir()) == before


def test_a_library_stays_when_the_next_one_cannot_be_built(made: Path, native: Path) -> None:
    (native / "two.c").write_text("what is this\n")
    with pytest.raises(build.BuildError, match=r"two\.c:1:1: error"):
        build.build(made)
    assert made.exists()


def test_a_function_that_nobody_wrote_is_found_when_it_is_built(made: Path, native: Path) -> None:
    (native / "two.c").write_text("int missing(void);\nint calls_it(void);\nint calls_it(void) { return missing(); }\n")
    with pytest.raises(build.BuildError, match="undefined reference to `missing'"):
        build.build(made)


def test_it_is_for_64_bit_processors_only(native: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "maxsize", 2**31 - 1)
    with pytest.raises(build.BuildError, match="the carrier is for 64-bit processors only"):
        build.build(native / "libcarrier.so")


def test_everyone_may_read_it(made: Path) -> None:
    """The service runs as a user of its own."""
    assert made.stat().st_mode & 0o444 == 0o444


def test_it_is_built_where_no_package_is_installed_and_tells_of_a_missing_compiler(tmp_path: Path) -> None:
    made = tmp_path / "made.so"
    script: list[str | Path] = [sys.executable, "-I", "-S", build.__file__, "--output", made]
    subprocess.run(script, check=True)
    assert subprocess.run([*script, "--check"], check=False).returncode == 0
    failed = subprocess.run(script, env={"CC": "no-compiler"}, capture_output=True, text=True, check=False)
    assert (failed.returncode, failed.stderr) == (
        1,
        "build: the C compiler 'no-compiler' cannot be run: No such file or directory\n",
    )


def test_a_build_without_headers_of_rcl_says_so(
    native: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ros = native.parent / "jazzy"
    monkeypatch.setattr(sys, "prefix", str(native.parent))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(ros))

    def run(*options: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["build.py", "--output", str(native / "libcarrier.so"), *options])
        return build.main(), capsys.readouterr().err

    (ros / "include" / "rmw").mkdir(parents=True)
    warning = "build: rcl_types.h was not checked: there are no headers of rcl in "
    said = f"{warning}{native.parent}/include or {ros}/include\n"
    assert run() == (0, said)
    assert run("--rcl") == (1, said)
    (ros / "include" / "rcl" / "rcl").mkdir(parents=True)
    (ros / "include" / "rcl" / "rcl" / "types.h").touch()
    assert run("--rcl") == (0, "")
