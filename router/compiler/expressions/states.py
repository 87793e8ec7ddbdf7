"""Which states a condition reads, and which part of it reads nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from router.compiler.expressions.tree import STATE, Logic, Node, Present, Read, Variable, nodes_in


def states_in(conditions: Iterable[Node | None]) -> list[str]:
    """Return the names of the states that conditions read, each once."""
    return [state_name(state) for state in state_variables(conditions)]


def state_variables(conditions: Iterable[Node | None]) -> list[Variable]:
    """Return the states that conditions read, each once."""
    nodes = (node for condition in conditions if condition is not None for node in nodes_in(condition))
    by_name: dict[str, Variable] = {}
    for node in nodes:
        if isinstance(node, Variable) and _is_state(node):
            by_name.setdefault(node.name, node)
    return [*by_name.values()]


def state_name(state: Variable) -> str:
    """Return the name of a state that a condition reads, without `state.`."""
    return state.name.removeprefix(f"{STATE}.")


def gate_of(conditions: Iterable[Node | None]) -> list[Node]:
    """Return the operands of a conjunction that read states, and nothing of the message."""
    return [each for each in operands_of(conditions) if states_in([each]) and not reads_message(each)]


def operands_of(conditions: Iterable[Node | None]) -> Iterator[Node]:
    """Yield the operands of a conjunction of conditions."""
    for condition in conditions:
        if isinstance(condition, Logic) and condition.is_all:
            yield from operands_of(condition.operands)
        elif condition is not None:
            yield condition


def _is_state(variable: Variable) -> bool:
    return variable.name.startswith(f"{STATE}.")


def reads_message(node: Node) -> bool:
    """Return whether a condition depends on the message."""
    return any(
        isinstance(each, (Read, Present)) or (isinstance(each, Variable) and not _is_state(each))
        for each in nodes_in(node)
    )
