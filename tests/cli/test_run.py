"""Which table `router run` takes, and what ROS parameters are for; test_starting.py has the running process."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, main
from router.errors import StartError
from router.ros.arguments import ros_parameters, table_variables

Run = Callable[..., tuple[int, str]]
BROKEN = "version: 1\nnobody: knows\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working directory with tables that tell by their findings which of them was read."""
    for name in ("routes/rover.yaml", "routes/legacy.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(BROKEN)
    return tmp_path


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """`router run` in that folder: its exit code, and the first line of what it says."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(signal, "pthread_sigmask", lambda *_: None)  # which would hold for the tests behind this one
    monkeypatch.setattr("router.cli.run.configure_log", lambda *_, **__: None)

    def run(*arguments: str) -> tuple[int, str]:
        return main(["run", *arguments]), capsys.readouterr().err.partition("\n")[0]

    return run


@pytest.mark.parametrize(
    ("arguments", "table"),
    [
        ((), "routes/rover.yaml"),
        (("routes/legacy.yaml",), "routes/legacy.yaml"),
        (("--ros-args", "-p", "routes_path:=routes/legacy.yaml"), "routes/legacy.yaml"),
        (("--ros-args", "-p", "rover_router:routes_path:='routes/legacy.yaml'"), "routes/legacy.yaml"),
        (("--ros-args", "-p", "routes_path:="), "routes/rover.yaml"),
        (("routes/legacy.yaml", "--ros-args", "-p", "routes_path:=routes/../routes/legacy.yaml"), "routes/legacy.yaml"),
        (("--ros-args", "--params-file", "parameters.yaml"), "routes/legacy.yaml"),
    ],
)
def test_the_table_is_an_argument_or_the_parameter_routes_path(
    run: Run, arguments: tuple[str, ...], table: str
) -> None:
    Path("parameters.yaml").write_text("/**:\n  ros__parameters:\n    routes_path: routes/legacy.yaml\n")
    code, line = run(*arguments)
    assert (code, line.partition(":")[0]) == (BAD_TABLE, table)


def test_two_different_tables_are_wrong_usage(run: Run) -> None:
    assert run("routes/rover.yaml", "--ros-args", "-p", "routes_path:=routes/legacy.yaml") == (
        BAD_USAGE,
        "router run: TABLE is routes/rover.yaml, routes_path is routes/legacy.yaml",
    )


def test_the_last_assignment_of_a_parameter_wins(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/rover:\n  router:\n    ros__parameters: {listen_port: 5002, dst_ip: 127.0.0.1}\n")
    words = ["-p", "listen_port:=5001", "--params-file", str(file), "--param", "dst_ip:=127.0.0.2", "-r", "a:=b"]
    assert ros_parameters(words) == {"listen_port": "5002", "dst_ip": "127.0.0.2"}


def test_every_parameter_but_routes_path_is_a_variable_of_the_table() -> None:
    assert table_variables({"listen_port": "5001", "routes_path": "a.yaml"}) == {"LISTEN_PORT": "5001"}


@pytest.mark.parametrize("text", ["a: [", None])
def test_a_parameter_file_that_cannot_be_read_is_told(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "parameters.yaml").write_text(text)
    with pytest.raises(StartError, match=r"the parameter file .* cannot be read"):
        ros_parameters(["--params-file", str(tmp_path / "parameters.yaml")])
