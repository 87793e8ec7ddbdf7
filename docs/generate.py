"""Writes the reference pages that come from the code: `python docs/generate.py`.

tests/test_docs.py fails if a page differs from what this would write.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill

from benchmarks.versus import claims
from benchmarks.versus.report import page as figures
from docs import reference_pages
from router.assets import asset
from router.compiler.expressions.functions import FUNCTIONS
from router.compiler.metrics import (
    CALL_BOUNDS_NS,
    CALL_OUTCOMES,
    CLIENT_DROP_REASONS,
    DROP_REASONS,
    GATEWAY_DROP_REASONS,
    GATEWAY_REJECT_REASONS,
    LATENCY_BOUNDS_NS,
    METRICS,
    RECORD_DROP_REASONS,
    REJECT_REASONS,
    RELOAD_RESULTS,
    STARTS,
    STOPPING_BOUNDS_NS,
    TOPIC_STATES,
)
from router.errors import Code
from router.rehearsal.reading import SCHEMA as TEST_SCHEMA
from router.table.grammar import table_schema
from tests.bad_tables.corpus import HERE as CORPUS
from tests.bad_tables.corpus import BadTable, good, sections

HERE = Path(__file__).parent
README = "../README.md"
RESULTS = HERE.parent / "benchmarks" / "results.json"
WIDTH = 118
_FIGURES = """\
[How they were measured](performance.md). Each scenario is described as it was at its commit."""
_MADE = "<!-- Made by docs/generate.py; edit the code, then run it again. -->\n"
_KEYS = """\
[The route table](table.md) explains how they work together. A dot separates a key from the keys inside it.

A **time** has a unit: `500us`, `20ms`, `1.5 s`, `10min`, `1h`. A **size** is in `B`, `kB`, `KiB`, `MB`, `MiB`, on
disk also `GB`, `GiB`. A **rate** is in `Hz`, or a number. Any value may contain `${NAME}` and `${NAME:-default}`.

At the top level:"""
_TEST_KEYS = """\
[Testing tables](../guides/test-tables.md) explains how they work together. A **time** has a unit: `300ms`, `2 s`.

At the top level:"""
_COMMANDS = """\
`router VERB --help` prints the same text. Every command uses `routes/rover.yaml`, unless `-t TABLE` or the variable
`ROUTER_TABLE` names another table. `eval "$(router --completion bash)"`, or `zsh`, lets the shell complete verbs and
options, and the table's payload cases, fields, endpoints and topics; in fish, use
`router --completion fish | source`.
"""
_COUNTERS = """\
Every series exists at 0 from the start. The counters balance. Per listener, received = rejected + accepted. Per route
and target, accepted + split = delivered + dropped + filtered + collected + waiting + held. Held messages are in open
frames, in the queue of a `bandwidth`, or held by `on_limit: latest`. Delivered means sent or published. With
`for_each`, each element is a message: the route accepts each one from ROS; for a topic, those after the first are
split. A reply counts the messages of its endpoint. A deadman's datagrams are counted only in its own metrics, and their
bytes nowhere."""
_UNCOUNTED = """\
The counters begin when a message has reached the router and end when it was handed to the kernel or to DDS. They do
not see:"""
_LOSSES = {
    "datagrams lost in the network, on the way to this computer or from it": "An endpoint that falls silent is a "
    "problem. Datagrams for which a listener's buffer has no room are counted in `router_kernel_drops_total`.",
    "messages that DDS loses between a publisher and the router, or between the router and a subscriber": "Nothing in "
    "the router: a topic counts a message as delivered when DDS has taken it. DDS may lose best-effort messages, and "
    "older ones than the queue holds. Compare with `router listen topic://NAME`.",
    "messages of publishers with another type": "DDS delivers none. `router_type_incompatible` counts these "
    "publishers and subscribers, and each is a problem.",
    "messages of publishers with incompatible QoS": "DDS delivers none. `router_qos_incompatible` counts the peers.",
}
_COMMANDED = """\
`command` is `true` for messages that go to a board or feed a deadman, and for messages of gateway clients if `inbound`
has a `ttl` or a deadman; else `false`."""
_GATEWAYS = """\
The name of a [gateway](table.md#gateways) is the `listener` and the `route` of its metrics. Messages to clients have
`clients` as target, and the transport (`udp`, `tcp`, `websocket`, `zenoh`) as destination; messages from clients have
`clients` as source, and the reasons of routes if they are dropped. The `route` of an inbound topic's deadman is gateway
and topic: `vr_headset:/cmd_vel`. Answered requests for schemas count as received, and neither as rejected nor as
accepted. The [gateway protocol](gateway-protocol.md#counters) says how these counters balance."""
_OWN = """\
[Recordings](../guides/record-and-replay.md) and taps do not affect routing: datagrams that they miss are counted only
here. A reload keeps all counters: the series of a removed route remain until the process ends, unless they are 0."""
_LOG = """\
The first drop of a kind (route, target, reason) is logged at once, further ones in summaries after 10 s, 20 s, 40 s and
so on up to 5 minutes. A summary shows the last drop, and the number of drops (`more`) in the `in_seconds` before it. So
a flood may be over when its last line appears; metrics are up to date."""
_DURATION = """\
`router_route_duration_seconds` ends when a datagram has been forwarded and queued for the thread that publishes it on
topics; for a message from ROS, when all targets are served. Its upper bounds, in microseconds:"""


def schema() -> str:
    """The schema of a table, from the declarations of its keys."""
    return json.dumps(table_schema(), indent=2) + "\n"


def keys_page() -> str:
    """Every key of a table, from its schema."""
    head = f"# Keys of a table\n\n{_MADE}\n{_KEYS}\n\n"
    return head + reference_pages.table_keys(table_schema())


def test_keys_page() -> str:
    """Every key of a test file, from its schema."""
    head = f"# Keys of a test file\n\n{_MADE}\n{_TEST_KEYS}\n\n"
    return head + reference_pages.test_keys(json.loads(asset(TEST_SCHEMA).read_text(encoding="utf-8")))


def commands_page() -> str:
    """Every verb, from its parser."""
    return "\n".join(["# Commands", "", _MADE, _COMMANDS, *reference_pages.commands(), ""])


def functions_page() -> str:
    """The functions of the expression language, from their declarations."""
    lines = ["# Functions in expressions", "", _MADE, "| function | meaning | examples |", "|---|---|---|"]
    for function in FUNCTIONS.values():
        examples = "<br>".join(f"`{expression}` is `{value!r}`" for expression, value in function.examples)
        lines.append(f"| `{function.signature}` | {function.summary} | {examples} |")
    lines += ["| `has(field)` | Whether a submessage or an optional field is set. | `when: has(bbox)` |", ""]
    return "\n".join(lines)


def metrics_page() -> str:
    """Every metric with its labels, from the counters."""
    latency = ", ".join(f"{bound / 1000:g}" for bound in LATENCY_BOUNDS_NS)
    stopping = ", ".join(f"{bound / 1e9:g}" for bound in STOPPING_BOUNDS_NS)
    calls = ", ".join(f"{bound / 1e9:g}" for bound in CALL_BOUNDS_NS)
    others = f"`router_deadman_stopping_seconds` has those at {stopping} s, `router_service_call_seconds` at {calls} s."
    lines = ["# Metrics", "", _MADE, "| metric | type | labels | meaning |", "|---|---|---|---|"]
    for metric in METRICS:
        kind = metric.kind if metric.kind in ("counter", "histogram") else "gauge"
        name = f"router_{metric.name}_total" if kind == "counter" else f"router_{metric.name}"
        lines.append(f"| `{name}` | {kind} | {', '.join(metric.exported_labels)} | {metric.help} |")
    lines += [
        "| `router_build_info` | gauge | version, table_sha256, protos_sha256, start | 1; the labels say what runs. |",
        "",
        fill(_COUNTERS, WIDTH),
        "",
        fill(_COMMANDED, WIDTH),
        "",
        "`route` is the payload case. Where a case has several routes, it also has the first source:",
        "[names](table.md#several-routes-of-one-case).",
        "",
        *_reasons("router_datagrams_rejected_total", REJECT_REASONS),
        *_reasons("router_messages_dropped_total", DROP_REASONS),
        *_reasons("router_service_calls_total", CALL_OUTCOMES, "outcome"),
        "## What is not counted",
        "",
        fill(_UNCOUNTED, WIDTH),
        "",
        "| not seen | what shows it |",
        "|---|---|",
        *(f"| {loss} | {shown} |" for loss, shown in _LOSSES.items()),
        "",
        "## Gateways",
        "",
        fill(_GATEWAYS, WIDTH),
        "",
        *_reasons("router_datagrams_rejected_total", GATEWAY_REJECT_REASONS),
        *_reasons("router_messages_dropped_total", GATEWAY_DROP_REASONS),
        *_reasons("router_client_messages_dropped_total", CLIENT_DROP_REASONS),
        *_reasons("router_gateway_topics", TOPIC_STATES, "state"),
        "## Recordings, reloads and starts",
        "",
        fill(_OWN, WIDTH),
        "",
        *_reasons("router_record_dropped_total", RECORD_DROP_REASONS),
        *_reasons("router_config_reloads_total", RELOAD_RESULTS, "result"),
        *_reasons("router_build_info", STARTS, "start"),
        "## Log and time",
        "",
        fill(_LOG, WIDTH),
        "",
        fill(f"{_DURATION} {latency}. {others}", WIDTH),
        "",
    ]
    return "\n".join(lines)


def _reasons(metric: str, reasons: Mapping[str, str], label: str = "reason") -> list[str]:
    rows = (f"| `{reason}` | {meaning} |" for reason, meaning in reasons.items())
    return [f"| {label} of `{metric}` | |", "|---|---|", *rows, ""]


def findings_page() -> str:
    """All codes of findings, each with a mistake and its correction from the tests' corpus."""
    lines = ["# Codes of findings", "", _MADE, "| code | severity | meaning |", "|---|---|---|"]
    lines += [f"| [`{code.value}`](#{code.value}) | {code.severity.value} | {code.meaning} |" for code in Code]
    for code in Code:
        page = CORPUS / f"{code.value}.md"
        mistake = next(sections(page))
        kind, text = good(page)
        lines += ["", f"## {code.value}", "", code.meaning, "", "```text", first_finding(mistake), "```", ""]
        correct = text.removeprefix("extends: base/base.yaml\n").strip() or text.strip()
        lines += ["Write instead:", "", f"```{kind}", correct, "```"]
    return "\n".join([*lines, ""])


def first_finding(mistake: BadTable) -> str:
    """The finding about the first mistake in a table, without the folder of the tests."""
    lines = mistake.said.splitlines()
    end = next(index for index, line in enumerate(lines) if index and not line.startswith((" ", "help: ")))
    severity = Code(mistake.code).severity.value  # the tests treat warnings as errors
    return "\n".join(lines[:end]).replace("bad_tables/", "").replace(": error[", f": {severity}[")


def figures_page() -> str:
    """The results of `make bench`."""
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    return f"# Figures\n\n{_MADE}\n{_FIGURES}\n\n{figures(found)}"


def readme() -> str:
    """The README, with the table of figures made from the results of `make bench`."""
    text = (HERE / README).read_text(encoding="utf-8")
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    begin, end = "<!-- Made by docs/generate.py: -->\n\n", "\n<!-- End. -->\n\n"
    before, _, rest = text.partition(begin)
    after = rest.partition(end)[2]
    return f"{before}{begin}{claims.table(found)}{end}{after}"


PAGES = {
    "../schemas/route-table.schema.json": schema,
    "reference/keys.md": keys_page,
    "reference/test-keys.md": test_keys_page,
    "reference/commands.md": commands_page,
    "reference/functions.md": functions_page,
    "reference/metrics.md": metrics_page,
    "reference/findings.md": findings_page,
    "design/figures.md": figures_page,
    README: readme,
}


def main() -> None:
    for name, written in PAGES.items():
        (HERE / name).write_text(written(), encoding="utf-8")


if __name__ == "__main__":
    main()
