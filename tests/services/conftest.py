"""A table with services."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable

PROTOS = Path(__file__).parents[1] / "bad_tables/protos/calls"
TABLE = """\
version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 127.0.0.1:5000}}
endpoints: {arm_board: {address: 127.0.0.40:8, kind: board, set: {req_id: sequence}}}
services:
  arm:
    type: std_srvs/srv/SetBool
    request: {case: arm_request, to: arm_board, fields: {armed: data, id: sequence}, ttl: 200ms}
    reply: {case: arm_reply, match: envelope.req_id, fields: {success: ok}}
    timeout: 500ms
    retries: 2
    on_timeout: {success: false, message: reason}
  arm_again:
    type: std_srvs/srv/SetBool
    request: {case: arm_request, to: arm_board, fields: {armed: data, id: sequence}, ttl: 200ms}
    reply: {case: arm_reply, match: envelope.req_id, fields: {success: ok}}
    timeout: 500ms
    on_timeout: {success: false}
  test:
    type: diagnostic_msgs/srv/SelfTest
    request: {case: arm_request, to: arm_board, fields: {id: sequence % 200}, ttl: {none: it tests only}}
    reply: {case: drive, fields: {id: "text(speed, 1)", passed: round(speed)}}
    timeout: 500ms
    on_timeout: {id: {text: nobody}}
  count:
    type: std_srvs/srv/Trigger
    request: {case: drive, to: arm_board, fields: {speed: "1"}, ttl: 200ms}
    reply: {case: log, fields: {success: "true"}}
    timeout: 500ms
    on_timeout: {success: false, message: reason}
routes: {}
"""


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> CompiledTable:
    return compiled(tmp_path_factory.mktemp("services"), PROTOS)


def compiled(folder: Path, protos: Path) -> CompiledTable:
    """Compile the table, which is written to `folder`."""
    path = folder / "table.yaml"
    path.write_text(TABLE.replace("PROTOS", str(protos)))
    checked = check_table(path, {})
    assert checked.program is not None, "\n".join(map(str, checked.diagnostics))
    return checked.program
