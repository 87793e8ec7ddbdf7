"""The meaning of `--ros-args` for a router, and which arguments have no effect. Pure: rcl parses them again."""

from __future__ import annotations

import fnmatch
from collections import ChainMap
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import yaml

from router import inputs
from router.compiler.compiled_table import CompiledTable
from router.compiler.topics import resolved
from router.errors import ConfigurationError, nearest
from router.table.model.settings import NodeSettings

ROUTES_PATH = "routes_path"

_PARAMETERS_OF_ROS = ("use_sim_time",)
_NODE_RULES = ("__node", "__name", "__ns")
_LOGGING = ("--log-level", "--log-config-file", "--log-file-name")
_SWITCHES = ("rosout-logs", "stdout-logs", "external-lib-logs")


class Parameter(NamedTuple):
    """A parameter. `node` is the name or pattern of the nodes that it is for; empty for all."""

    node: str
    name: str
    value: str


class Rule(NamedTuple):
    """A remap rule. `node` is the name of the node that it is for; empty for all."""

    node: str
    match: str
    text: str


def ros_parameters(ros_args: Sequence[str]) -> dict[str, str]:
    """Parse `["-p", "listen_port:=5001"]` to `{"listen_port": "5001"}`, also `--params-file`, which `ros2 launch` uses.

    The last value wins, as in ROS. Node names of parameters are ignored. Raises StartError.
    """
    return {parameter.name: parameter.value for parameter in _parameters(ros_args)}


def table_variables(parameters: Mapping[str, str]) -> dict[str, str]:
    """Return the table's variables set by ROS parameters: `listen_port` sets `${LISTEN_PORT}`."""
    return {name.upper(): value for name, value in parameters.items() if name != ROUTES_PATH}


class Variables(ChainMap[str, str]):
    """Variables of a table, each from the first of `values` that has it. `names_read` are those that were looked up."""

    def __init__(self, *values: Mapping[str, str]) -> None:
        super().__init__(*values)  # type: ignore[arg-type]  # they are only read
        self.names_read: set[str] = set()

    def get(self, name: str, default: str | None = None) -> str | None:  # type: ignore[override]  # texts only
        self.names_read.add(name)
        return super().get(name, default)


def without_effect(
    ros_args: Sequence[str], program: CompiledTable, names_read: Collection[str]
) -> Iterator[tuple[str, str]]:
    """Yield each argument that has no effect, with a remedy. `names_read` are the names of the table's variables.

    Parameters for another node are skipped.
    """
    rules = list(_rules(ros_args))
    node = _remapped(program.table.node, rules)
    has_node = program.uses_ros
    variables = sorted(name.lower() for name in names_read)
    for owner, name in dict.fromkeys((parameter.node, parameter.name) for parameter in _parameters(ros_args)):
        read = {*variables, ROUTES_PATH, *(_PARAMETERS_OF_ROS if has_node else ())}
        if name not in read and _is_for(owner, node):
            yield f"-p {name}", _for_parameter(name, read, variables)
    topics = _topics(program, node)
    for rule in rules:
        if not has_node:
            yield f"-r {rule.text}", "the table has no topics, services or gateways, so no ROS node"
        elif rule.match not in _NODE_RULES or not _is_for(rule.node, program.table.node):
            if not _is_for(rule.node, node):
                yield f"-r {rule.text}", f"it is for the node '{rule.node}', but this one is '{node.name}'"
            elif resolved(rule.match.removeprefix("rostopic://").removeprefix("rosservice://"), node) not in topics:
                yield f"-r {rule.text}", _for_rule(rule.match, topics, node)
    for option in ros_args:
        if option in _LOGGING or option.removeprefix("--enable-").removeprefix("--disable-") in _SWITCHES:
            yield option, "the router has its own log: use `router run --log-level LEVEL`, before `--ros-args`"


def _for_parameter(name: str, read: Collection[str], variables: Sequence[str]) -> str:
    if name.partition(".")[0] == "qos_overrides":
        return "the `qos` of each topic in the table decides"
    if (near := nearest(name, read)) is not None:
        return f"did you mean '{near}'?"
    return f"the table's variables are {', '.join(variables)}" if variables else "the table has no variables"


def _for_rule(match: str, topics: Mapping[str, str], node: NodeSettings) -> str:
    near = nearest(match, topics.values()) or nearest(resolved(match, node), topics)
    return f"did you mean '{near}'?" if near else "no topic or service of the table has this name"


def _topics(program: CompiledTable, node: NodeSettings) -> dict[str, str]:
    """Return the topics and services as the table writes them, by absolute name."""
    plans = [plan.topic for plan in (*program.publishers, *program.subscriptions)]
    inbound = [entry.topic.topic.value for gateway in program.gateways for entry in gateway.settings.inbound]
    services = [*(plan.name for plan in program.services), *(plan.service for plan in program.called)]
    services += [plan.service for plan in program.client_calls]
    return {resolved(name, node): name for name in (*plans, *inbound, *services)}


def _remapped(node: NodeSettings, rules: Sequence[Rule]) -> NodeSettings:
    """Return the node's name and namespace after remapping. The first rule wins, as in ROS."""
    for rule in reversed(rules):
        if _is_for(rule.node, node):
            new = rule.text.partition(":=")[2]
            if rule.match in ("__node", "__name"):
                node = replace(node, name=new)
            elif rule.match == "__ns":
                node = replace(node, namespace=new)
    return node


def _is_for(owner: str, node: NodeSettings) -> bool:
    """Return whether a parameter or rule for this node name or pattern applies to the router."""
    return not owner or fnmatch.fnmatchcase(node.name, owner.rpartition("/")[2])


def _rules(ros_args: Sequence[str]) -> Iterator[Rule]:
    for option, word in pairwise(ros_args):
        match, assigned, _ = word.partition(":=")
        if option in ("-r", "--remap") and assigned:
            scheme, colon, rest = match.partition("://")
            node, _, name = (rest if colon else match).rpartition(":")
            yield Rule(node, f"{scheme}://{name}" if colon else name, word)


def _parameters(ros_args: Sequence[str]) -> Iterator[Parameter]:
    """Yield all parameters, in order. Raises StartError."""
    for option, word in pairwise(ros_args):
        name, assigned, value = word.partition(":=")
        if option in ("-p", "--param") and assigned:
            node, _, short = name.rpartition(":")
            yield Parameter(node, short, value.strip("'\""))
        elif option == "--params-file":
            yield from _of_tree("", _read_yaml(Path(word)))


def _read_yaml(path: Path) -> object:
    try:
        return yaml.safe_load(inputs.read_text(path))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigurationError(f"the parameter file {path} cannot be read: {error}") from error


def _of_tree(node: str, tree: object) -> Iterator[Parameter]:
    """Yield the parameters of all nodes, at any depth of namespaces."""
    for key, value in tree.items() if isinstance(tree, dict) else ():
        if key == "ros__parameters" and isinstance(value, dict):
            yield from (Parameter(node, str(name), str(member)) for name, member in value.items())
        else:
            yield from _of_tree(str(key), value)
