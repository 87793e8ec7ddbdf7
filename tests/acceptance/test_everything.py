"""Every tool takes every feature of protobuf that the router forwards, and values without a JSON form."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.unknown_fields import UnknownFieldSet

from router.cli import BAD_TABLE, BAD_USAGE, main
from router.tools.running_router import post
from router.values.printing import protobuf_tree, words
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import RouterProcess, Site, site, wait_until
from tests.everything import odd, payload, unroutable, usual, wire
from tests.observe.foxglove_client import FoxgloveClient
from tests.ports import free_port
from tests.repeating import repeating

CASES = [*wire().envelopes.first.cases]
ACCEPTED = {**usual(), **odd()}
DATAGRAMS = {**ACCEPTED, **unroutable()}

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/everything, message: Envelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
foxglove: {{address: 127.0.0.1:FOXGLOVE}}
record: {{directory: recordings, last: 60s}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
{endpoints}
routes:
  heartbeat: {{ignore: it says only that the link works}}
""" + "".join(f"  {case}: {{{{source: source_tool, destinations: [basestation]}}}}\n" for case in CASES)


class Place:
    """A running router whose table has a route for each payload case, and its recording of all datagrams."""

    def __init__(self, place: Site, table: Path, foxglove: int) -> None:
        self.site, self.table, self.foxglove = place, table, foxglove

    def json(self, path: str) -> Any:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.site.metrics}{path}", timeout=PATIENCE) as answer:
            return json.loads(answer.read())

    def sending(self, *datagrams: bytes) -> AbstractContextManager[None]:
        """Send these datagrams again and again."""
        return repeating(partial(self.site.send, "source_tool", *datagrams), 0.2)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder, foxglove = tmp_path_factory.mktemp("everything"), free_port()
    with site(folder, {"source_tool": "127.0.0.30", "basestation": "127.0.0.10"}) as opened:
        table = opened.table(TABLE.replace("FOXGLOVE", str(foxglove)))
        with RouterProcess(folder, table) as router:
            yield Place(opened, table, foxglove)
            assert [line for line in router.log() if line["level"] in {"error", "critical"}] == []


@pytest.fixture(scope="module")
def recording(place: Place) -> Path:
    """A recording of all datagrams. The router has forwarded those with a route byte for byte."""
    before = place.site.scrape()
    place.site.waiting()
    place.site.send("source_tool", *DATAGRAMS.values())
    place.site.settle(before, len(DATAGRAMS))
    assert place.site.waiting() == {"basestation": [*ACCEPTED.values()]}
    answer = post(f"http://127.0.0.1:{place.site.metrics}", "/record/save")
    return Path(answer.body["file"])


Said = Callable[..., Sequence[str]]


@pytest.fixture
def said(place: Place, capsys: pytest.CaptureFixture[str]) -> Said:
    """Run a verb with the table. Return the lines that it prints."""

    def run(*arguments: object) -> Sequence[str]:
        table = () if arguments[0] in {"show", "test"} else ("-t", place.table)
        code = main([*map(str, (*arguments, *table))])
        out, err = capsys.readouterr()
        assert code == 0, out + err
        return out.splitlines()

    return run


def test_what_is_no_message_is_counted_as_unhandled_or_as_ignored(place: Place, recording: Path, said: Said) -> None:
    del recording  # all datagrams have been sent
    samples = place.site.samples()
    for name in unroutable():
        assert samples[f'unhandled_total{{payload_case="{name}"}}'] == (name != "heartbeat")
    assert samples['datagrams_rejected_total{listener="rover",reason="ignored"}'] == 1


@pytest.mark.parametrize("verb", ["validate", "explain"])
def test_the_table_is_valid(verb: str, said: Said) -> None:
    assert said(verb)


def test_the_table_is_drawn(tmp_path: Path, said: Said) -> None:
    said("graph", "-o", tmp_path / "it.mmd")


def words_of(case: str) -> Sequence[str]:
    return [word for word in words(protobuf_tree(payload(case), wire().case(case).type)) if word != "="]


@pytest.mark.parametrize("case", CASES)
def test_words_make_each_payload(case: str, place: Place, said: Said) -> None:
    """`listen` and `tap` print them."""
    place.site.waiting()
    said("send", case, *words_of(case), "--to", "basestation")
    assert place.site.receive("basestation") == usual()[case]
    assert any("is sent to basestation" in line for line in said("explain", case, "--given", *words_of(case)))


@pytest.mark.parametrize("options", [(), ("--json",), ("--hex",)])
def test_tap(options: Sequence[str], place: Place, said: Said) -> None:
    with place.sending(*DATAGRAMS.values()):
        lines = said("tap", *options, "--count", 2 * len(DATAGRAMS))
    if options == ("--json",):
        shown = {line.get("case") or line["problem"] for line in map(json.loads, lines)}
        assert {*CASES, "unhandled: heartbeat is uint32, not a message"} <= shown


@pytest.mark.parametrize(
    ("condition", "case"),
    [("needed < 0", "old"), ("u32 > 0 and open != Open.OPEN_ZERO", "plain"), ("implicit == -49 or True", "edition"),
     ("at.seconds == 1", "known"), ("whole.value == 7", "known")],
)  # fmt: skip
def test_tap_and_show_select_by_value(condition: str, case: str, place: Place, recording: Path, said: Said) -> None:
    with place.sending(*DATAGRAMS.values()):
        assert f" {case} " in said("tap", "--where", condition, "--count", 1)[0]
    assert any(f" {case} " in line for line in said("show", recording, "--where", condition))


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_listen(options: Sequence[str], place: Place, said: Said) -> None:
    port = free_port()

    def send() -> None:
        for datagram in DATAGRAMS.values():
            place.site.endpoints["source_tool"].sendto(datagram, ("127.0.0.1", port))

    with repeating(send, 0.2):
        assert said("listen", f"envelope://127.0.0.1:{port}", *options, "--count", 2 * len(DATAGRAMS))


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_show(options: Sequence[str], recording: Path, said: Said) -> None:
    assert len(said("show", recording, *options)) >= len(DATAGRAMS)


def test_replay(place: Place, recording: Path, said: Said) -> None:
    place.site.waiting()
    before = place.site.scrape()
    said("replay", recording, "--speed", "max", "--from", "127.0.0.30", "--to", "rover")
    place.site.settle(before, len(DATAGRAMS))
    said("replay", recording, "--against", place.table)


def test_status_page(place: Place) -> None:
    with place.sending(*DATAGRAMS.values()):
        values: dict[str, Any] = {}

        def has_all() -> bool:
            values.update(place.json("/status.json")["values"])
            return values.keys() >= set(CASES)

        wait_until(has_all, "a value of each case")


def test_foxglove(place: Place) -> None:
    with FoxgloveClient(place.foxglove) as client, place.sending(*DATAGRAMS.values()):
        assert client.channels.keys() == set(CASES)
        client.subscribe(*CASES)
        waiting = set(CASES)
        for _ in range(10 * len(DATAGRAMS)):
            if not waiting:
                break
            told = client.receive()
            assert not len(UnknownFieldSet(told.message)) or told.topic == "old"  # a number that no enum has
            waiting.discard(told.topic)
        assert not waiting


def test_simulator(place: Place, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It sends to the router of its table, and receives from it; here, from the other one."""
    text = place.table.read_text().replace("127.0.0.30:", "127.0.0.31:").replace("127.0.0.10:", "127.0.0.11:")
    table = tmp_path / "sim.yaml"
    table.write_text(text)
    assert main(["sim", "-t", str(table), "--for", "2s", "--json"]) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["sent"]["source_tool"].keys() == set(CASES)


def test_table_test(tmp_path: Path, place: Place, said: Said) -> None:
    tests = ["tests:"]
    for name, datagram in ACCEPTED.items():
        given = f"given: {{from: source_tool, hex: '{datagram.hex()}'}}"
        tests.append(f"  {name}:\n    {given}\n    expect: {{sent: {{basestation: unchanged}}}}")
    path = tmp_path / "everything.test.yaml"
    path.write_text(f"table: {place.table}\n" + "\n".join(tests) + "\n")
    said("test", path)


def test_a_missing_required_field_is_named_with_its_place(
    tmp_path: Path, place: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = "old.Old requires needed"
    for verb in (["send", "old", "--to", "basestation"], ["explain", "old", "--given"]):
        assert main([*verb, "-t", str(place.table)]) == BAD_USAGE
        assert f"{missing}\nhelp: give needed a value\n" in capsys.readouterr().err
    path = tmp_path / "missing.test.yaml"
    test = "it: {given: {from: source_tool, case: old, fields: {texts: [a]}}, expect: {sent: basestation}}"
    path.write_text(f"table: {place.table}\ntests:\n  {test}\n")
    assert main(["test", str(path)]) == BAD_TABLE
    told = "".join(capsys.readouterr())
    assert f"{path}:3:" in told
    assert missing in told
