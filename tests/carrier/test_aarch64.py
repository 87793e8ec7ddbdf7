"""The carrier for aarch64, made by cross compilers and run by qemu-user: it does what it does on this processor."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from router.carrier import build as carrier
from router.carrier.build import NATIVE
from tests.carrier.fuzz import build, build_machine
from tests.carrier.fuzz.compiling import Compile, for_corpus

GCC, QEMU = "aarch64-linux-gnu-gcc", "qemu-aarch64-static"
SYSTEM = Path("/usr/aarch64-linux-gnu")
COMPILERS = {"gcc": (GCC,), "clang": ("clang", "--target=aarch64-linux-gnu")}
EMULATED = (QEMU, "-L", str(SYSTEM))
PROGRAMS = Path(__file__).parent / "programs"

Build = Callable[[Path, Compile], Path]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(platform.machine() == "aarch64", reason="all other tests run on aarch64 here"),
]


def needs(command: str) -> None:
    if shutil.which(command) is None or not SYSTEM.is_dir():
        pytest.skip(f"needs {command} and {SYSTEM}: gcc-aarch64-linux-gnu, libc6-dev-arm64-cross, qemu-user-static")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for command in (GCC, QEMU):
        needs(command)
    return carrier.build(tmp_path_factory.mktemp("aarch64") / "libcarrier.so", compiler=GCC)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_compilers_have_nothing_to_warn_of(compiler: str, tmp_path: Path) -> None:
    command, *options = COMPILERS[compiler]
    needs(command)
    for source in carrier.sources():
        made = ["-O2", "-c", "-o", str(tmp_path / "made.o")]
        carrier.compile_c([str(source), *options, *carrier.rcl_headers(), *carrier.WARNINGS, *made], command)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("brakes", ["1000"]),
        ("from_ros", []),
        ("publish", []),
        ("queue", ["300000", "512"]),
        ("queue", ["300000", "65536"]),
        ("storm", ["1000"]),
        ("wakes", ["50000", "1"]),
        ("wakes", ["50000", "2"]),
        ("wakes", ["50000", "3"]),
    ],
)
def test_programs_pass(name: str, arguments: Sequence[str], library: Path, tmp_path: Path) -> None:
    """See the tests that run them without an emulator."""
    made = tmp_path / name
    found = ["-o", str(made), f"-I{NATIVE}", str(library), f"-Wl,-rpath,{library.parent}"]
    carrier.compile_c([str(PROGRAMS / f"{name}.c"), "-O2", *found], GCC)
    done = subprocess.run([*EMULATED, made, *arguments], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    "fuzzed",
    [
        lambda folder, compile_: build.build(folder, "envelope_fuzz", compile_),
        lambda folder, compile_: build.build(folder, "handle_fuzz", compile_),
        lambda folder, compile_: build_machine.build(folder, compile_, count=0),  # a NaN's sign is the processor's
    ],
    ids=["envelope", "handle", "machine"],
)
def test_inputs_of_fuzz_targets_have_the_same_outcome(fuzzed: Build, tmp_path: Path) -> None:
    for command in (GCC, QEMU):
        needs(command)

    def compile_both(files: Sequence[Path], program: Path) -> None:
        for_corpus(files, program)
        for_corpus(files, program.with_suffix(".aarch64"), GCC)

    program = fuzzed(tmp_path, compile_both)
    here, there = (
        subprocess.run([*run, tmp_path / "corpus"], capture_output=True, text=True, check=True, timeout=300).stdout
        for run in ([program], [*EMULATED, program.with_suffix(".aarch64")])
    )
    assert there.splitlines() == here.splitlines()
