"""Requests and replies as the carrier maps them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.rehearsal.cdr import deserialize, serialize
from router.services.calls import Calls, number_in
from router.types.ros import ros_interfaces
from tests.carrier.simulated import START, Simulated
from tests.services.conftest import PROTOS, compiled

BOARD = ("127.0.0.40", 8)
INTERFACES = ros_interfaces()


class Stage:
    """Calls on the simulation: sends requests and takes replies as the router does."""

    def __init__(self, program: CompiledTable) -> None:
        self.program, self.simulated = program, Simulated(program)
        self.calls: Calls[str] = Calls(program.services, program.envelopes, self)
        self.responses: dict[str, bytes] = {}
        self._seen = 0

    def _outputs(self, target: str) -> list[bytes]:
        return self.simulated.to(target)

    def call(self, service: str, caller: str, type_: str, **values: Any) -> Any:
        """Call, and return the envelope that is sent."""
        request = INTERFACES.get(f"{type_}_Request")
        assert request is not None
        self.calls.call(f"service.{service}", caller, serialize(request, values), START, START)
        return self.program.envelopes.first.message_class.FromString(self._outputs("arm_board")[-1])

    def reply(self, service: str, **values: Any) -> None:
        datagram = self.program.envelopes.first.message_class(**values).SerializeToString()
        self.simulated.simulation.datagram("rover", BOARD, datagram, START)
        for message in self._outputs(f"service.{service}")[self._seen :]:
            self._seen += 1
            self.calls.reply(f"service.{service}", message, START)

    def response(self, caller: str, type_: str) -> SimpleNamespace:
        response = INTERFACES.get(f"{type_}_Response")
        assert response is not None
        return deserialize(response, self.responses[caller])

    # effects of calls

    def send(self, plan: Any, request: bytes, called_at: int) -> bytes | str:
        self.simulated.simulation.message(plan.label, request, called_at)
        return self._outputs("arm_board")[-1]

    def send_again(self, plan: Any, datagram: bytes) -> str | None:
        raise AssertionError

    def answer(self, plan: Any, caller: str, response: bytes) -> None:
        self.responses[caller] = response

    def ended(self, plan: Any, outcome: str, duration: int) -> None: ...

    def unmatched(self, plan: Any, number: int | None) -> None: ...


@pytest.fixture
def stage(program: CompiledTable) -> Stage:
    return Stage(program)


ARM, SELF_TEST, TRIGGER = "std_srvs/srv/SetBool", "diagnostic_msgs/srv/SelfTest", "std_srvs/srv/Trigger"


def test_a_request_and_its_reply(stage: Stage) -> None:
    sent = stage.call("arm", "a", ARM, data=True)
    assert (sent.req_id, sent.arm_request.armed, sent.arm_request.id) == (1, True, 1)
    sent = stage.call("arm", "b", ARM, data=False)
    assert (sent.req_id, sent.arm_request.armed, sent.arm_request.id) == (2, False, 2)
    stage.reply("arm", req_id=2, arm_reply={"ok": True})
    assert stage.response("b", ARM) == SimpleNamespace(success=True, message="")
    assert "a" not in stage.responses


def test_numbers_go_on_after_a_reload(stage: Stage, program: CompiledTable) -> None:
    stage.call("arm", "a", ARM, data=True)
    stage.calls = Calls(program.services, program.envelopes, stage, stage.calls.numbers)
    assert stage.call("arm", "b", ARM, data=True).arm_request.id == 2


def test_a_service_begins_with_the_number_after_the_first(stage: Stage, program: CompiledTable) -> None:
    stage.calls = Calls(program.services, program.envelopes, stage, first=1_700_000_000_000)
    first = stage.call("arm", "a", ARM, data=True).arm_request.id
    assert first == 1_700_000_000_000 % (2**31 - 1) + 1
    assert stage.call("arm", "b", ARM, data=True).arm_request.id == first + 1


@pytest.mark.parametrize(("size", "most"), [(8, 255), (16, 65535), (32, 2**31 - 1)])
def test_numbers_begin_again_where_the_board_stores_no_more(tmp_path: Path, size: int, most: int) -> None:
    protos = tmp_path / "protos"
    shutil.copytree(PROTOS, protos)
    (protos / "envelope.options").write_text(f"ArmRequest.id int_size:{size}\n")
    program = compiled(tmp_path, protos)
    stage = Stage(program)
    stage.calls = Calls(program.services, program.envelopes, stage, first=most - 1)
    assert [stage.call("arm", "a", ARM, data=True).arm_request.id for _ in range(3)] == [most, 1, 2]


def test_a_type_without_request_fields_and_a_reply_without_number(stage: Stage) -> None:
    assert stage.call("count", "a", TRIGGER).drive.speed == 1
    stage.reply("count", log={"number": 3})
    assert stage.response("a", TRIGGER) == SimpleNamespace(success=True, message="")


def test_numbers_before_responses_keep_their_layout(stage: Stage) -> None:
    stage.call("test", "a", SELF_TEST)
    stage.reply("test", drive={"speed": 7})
    assert stage.response("a", SELF_TEST) == SimpleNamespace(id="7.0", passed=7, status=[])


def test_on_timeout_is_a_response(program: CompiledTable) -> None:
    plans = {plan.name: plan for plan in program.services}
    arm, self_test = INTERFACES.get(f"{ARM}_Response"), INTERFACES.get(f"{SELF_TEST}_Response")
    assert arm is not None
    assert self_test is not None
    said = {outcome: deserialize(arm, message).message for outcome, message in plans["arm"].responses.items()}
    assert said == {
        "timed_out": "arm_board did not reply within 500 ms",
        "busy": "arm_board has not replied to an earlier call",
        "unsent": "arm_board cannot be sent to",
        "refused": "the request is too old, or arm_board cannot take its values",
        "cancelled": "the router has reloaded its table, or stops",
    }
    assert deserialize(self_test, plans["test"].responses["busy"]).id == "nobody"


def test_the_example_of_the_reference_is_a_table(tmp_path: Path) -> None:
    page = Path("docs/reference/table.md").read_text(encoding="utf-8")
    found = re.search(r"^## Services\n\n```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert found is not None
    table = tmp_path / "table.yaml"
    head = f"version: 1\nenvelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}\n"
    others = "listen: {rover: {address: 192.168.0.1:5000}}\nroutes: {drive: {ignore: no use}, log: {ignore: no use}}\n"
    table.write_text(head + found[1] + others)
    assert list(map(str, check_table(table, {}).diagnostics)) == []


@pytest.mark.parametrize("number", [0, 1, 2**32 - 1])
def test_the_number_of_a_datagram(program: CompiledTable, number: int) -> None:
    datagram = program.envelopes.first.message_class(req_id=number, arm_request={"id": 5}).SerializeToString()
    assert number_in(program.envelopes.first, datagram, ("envelope", "req_id")) == number
    assert number_in(program.envelopes.first, datagram, ("id",)) == 5


def test_the_number_of_a_datagram_without_its_trailing_zeros(program: CompiledTable) -> None:
    datagram = program.envelopes.first.message_class(req_id=7, drive={}).SerializeToString()
    assert datagram[-1] == 0
    assert number_in(program.envelopes.first, datagram[:-1], ("envelope", "req_id")) == 7
