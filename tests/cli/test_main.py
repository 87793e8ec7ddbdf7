from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from router import __version__
from router.cli import (
    BAD_TABLE,
    BAD_USAGE,
    BROKEN_PIPE,
    INTERRUPTED,
    NETWORK_FAULT,
    NOT_NOW,
    OK,
    UNWRITTEN,
    VERBS,
    main,
    validate,
)
from router.errors import (
    Code,
    ConfigurationError,
    Diagnostic,
    SourceSpan,
    StartError,
    TableError,
    TransportError,
    UsageError,
)
from tests.tables import ROUTES

REPOSITORY = Path(__file__).parents[2]


def test_alone_it_prints_help_with_every_verb_and_imports_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main([]) == OK
    rows = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if len(line.split()) > 1)
    for verb, summary in VERBS.items():
        assert rows[verb] == summary


@pytest.mark.parametrize("words", ["--completion bash", "status --url http://127.0.0.1:1"])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_disk_below_stdout_is_a_line(words: str, unbuffered: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    router = f"exec {sys.executable} -m router {words} >/dev/full"
    done = subprocess.run(["/bin/sh", "-c", router], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == UNWRITTEN
    assert re.fullmatch("router( status)?: stdout: No space left on device\n", done.stderr)


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"router {__version__}\n"


@pytest.mark.parametrize(
    ("error", "code", "shown"),
    [
        (TableError([Diagnostic(SourceSpan("t.yaml", 3, 4), Code.BAD_YAML, "what")]), BAD_TABLE, "t.yaml:3:4: error"),
        (StartError("port 5000 is taken"), NOT_NOW, "router validate: port 5000 is taken\n"),
        (StartError("no port", "choose another"), NOT_NOW, "router validate: no port\nhelp: choose another\n"),
        (ConfigurationError("no such type"), BAD_TABLE, "router validate: no such type\n"),
        (
            RuntimeError("can't start new thread"),
            NOT_NOW,
            "descriptors have run out: can't start new thread",
        ),
        (MemoryError(), NOT_NOW, "have run out: no memory"),
        (OSError(errno.EMFILE, "Too many open files"), NOT_NOW, "have run out: [Errno 24] Too many open files"),
        (ImportError("x.so: cannot open shared object file: Too many open files"), NOT_NOW, "have run out: x.so: "),
        (UsageError("there is no x"), BAD_USAGE, "router validate: there is no x"),
        (TransportError("nobody answers"), NETWORK_FAULT, "router validate: nobody answers"),
        (KeyboardInterrupt(), INTERRUPTED, ""),
    ],
)
def test_what_a_verb_raises_becomes_an_exit_code(
    error: BaseException,
    code: int,
    shown: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(args: object) -> int:
        raise error

    monkeypatch.setattr(validate, "run", fail)
    assert main(["validate", "x.yaml"]) == code
    assert shown in capsys.readouterr().err


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_findings_that_nobody_reads_end_it_as_output_does(unbuffered: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing) as stderr:
        done = subprocess.run([sys.executable, "-m", "router", "valdate"], cwd=REPOSITORY, stderr=stderr, check=False)
    assert done.returncode == BROKEN_PIPE


def test_a_reader_that_leaves_early_is_no_reason_to_complain() -> None:
    command = [sys.executable, "-m", "router", "validate", "--json", *["nope.yaml"], *map(str, range(3000))]
    process = subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout
    process.stdout.close()
    assert process.stderr
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == BROKEN_PIPE


def test_a_caller_may_close_the_standard_streams(tmp_path: Path) -> None:
    for number, closed in enumerate(("<&-", ">&-", "2>&-", "<&- >&- 2>&-")):
        router = [sys.executable, "-m", "router", "init", str(tmp_path / str(number))]
        subprocess.run(["/bin/sh", "-c", f'exec "$@" {closed}', "sh", *router], cwd=REPOSITORY, check=True)


def test_validate_imports_neither_ros_nor_what_a_person_looks_at() -> None:
    script = "import sys; from router.cli import main; main(sys.argv[1:]); print(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", script, "validate", str(ROUTES / "sim.yaml")]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    unwanted = {"rclpy", "rich", "structlog", "prometheus_client", "router.app", "router.cli.run"}
    assert unwanted.isdisjoint(result.stderr.split())


def test_without_what_the_headers_declare_a_sentence_says_what_to_do() -> None:
    script = "import sys; sys.modules['router.declared'] = None; from router import main; sys.exit(main(['validate']))"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (
        BAD_TABLE,
        "",
        "router validate: router/declared.py does not match the headers of the carrier\nhelp: run 'make setup'\n",
    )
