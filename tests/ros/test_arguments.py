"""Which ROS arguments have no effect on a router, and what was meant."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.compiler import check_table
from router.ros.arguments import Variables, ros_parameters, table_variables, without_effect

TABLE = """\
version: 1
node: {name: rover_router, diagnostics: true}
http: {address: "127.0.0.1:${PORT:-9108}"}
gateways:
  dashboard:
    transport: {websocket: "127.0.0.1:${PAGE:-8765}"}
    inbound: [{topic: cmd_vel, type: geometry_msgs/msg/Twist}]
"""
FILE = """\
/**: {ros__parameters: {prot: 1, use_sim_time: true}}
rover_router: {ros__parameters: {qos_overrides: {/imu: {publisher: {depth: 5}}}, page: 9000}}
camera: {ros__parameters: {exposure: 7}}
"""


def unread(tmp_path: Path, *words: str, table: str = TABLE) -> dict[str, str]:
    (tmp_path / "table.yaml").write_text(table)
    (tmp_path / "params.yaml").write_text(FILE)
    words = tuple(word.format(folder=tmp_path) for word in words)
    variables = Variables({}, table_variables(ros_parameters(words)))
    program = check_table(tmp_path / "table.yaml", variables).program
    assert program is not None
    return dict(without_effect(words, program, variables.names_read))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("-p", "port:=9999", "-p", "use_sim_time:=false", "-p", "camera:exposure:=7"), {}),
        (("-p", "prot:=9999"), {"-p prot": "did you mean 'port'?"}),
        (("-p", "rover_router:zoom:=1"), {"-p zoom": "the table's variables are page, port"}),
        (
            ("-p", "start_type_description_service:=true"),
            {"-p start_type_description_service": "the table's variables are page, port"},
        ),
        (
            ("--params-file", "{folder}/params.yaml"),
            {
                "-p prot": "did you mean 'port'?",
                "-p qos_overrides": "the `qos` of each topic in the table decides",
            },
        ),
        (
            ("-p", "qos_overrides./imu.publisher.depth:=5"),
            {"-p qos_overrides./imu.publisher.depth": "the `qos` of each topic in the table decides"},
        ),
        (("-r", "cmd_vel:=drive", "-r", "/diagnostics:=/d", "-r", "__ns:=/one", "-r", "/one/cmd_vel:=x"), {}),
        (("-r", "cmd_vell:=drive"), {"-r cmd_vell:=drive": "did you mean 'cmd_vel'?"}),
        (("-r", "__ns:=/one", "-r", "/cmd_vel:=x"), {"-r /cmd_vel:=x": "did you mean 'cmd_vel'?"}),
        (("-r", "__node:=other", "-r", "other:cmd_vel:=x", "-p", "other:prot:=1"), {"-p prot": "did you mean 'port'?"}),
        (
            ("-r", "camera:cmd_vel:=x"),
            {"-r camera:cmd_vel:=x": "it is for the node 'camera', but this one is 'rover_router'"},
        ),
        (
            ("--log-level", "debug", "--disable-stdout-logs"),
            dict.fromkeys(
                ("--log-level", "--disable-stdout-logs"),
                "the router has its own log: use `router run --log-level LEVEL`, before `--ros-args`",
            ),
        ),
    ],
)
def test_what_nothing_reads_is_named_with_what_was_meant(
    tmp_path: Path, words: tuple[str, ...], told: dict[str, str]
) -> None:
    assert unread(tmp_path, *words) == told
