"""The lengths of lists in payloads that the mappings of a table need, for `router sim`.

`x[3]` needs four elements, an array of ROS exactly as many as it has, a bounded sequence at most as many as it takes.
Lists that are combined element by element need the same length. Bytes count as a list.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from router.compiler.checked import CheckedRoute
from router.compiler.expressions import tree
from router.compiler.plan import Each, Items, Leaf, Plan, Record
from router.types.model import Bytes, List

USUAL_LENGTH = 3
"""Elements of a list if nothing needs another number."""


def needed_lengths(routes: Iterable[CheckedRoute]) -> dict[str, int]:
    """Return the lengths of lists that mappings use, by payload case and names of fields, as in `power.pack.cells`.

    Of needs that contradict each other, one is met.
    """
    needs = _Needs()
    for checked in routes:
        needs.of_route(checked)
    return {path: group.length for group in needs.groups for path in group.paths}


@dataclass(slots=True)
class _Group:
    """Lists of the same length, by their paths."""

    paths: set[str]
    least: int = 0
    most: int = sys.maxsize
    exact: int = 0

    @property
    def length(self) -> int:
        return self.exact or max(self.least, min(USUAL_LENGTH, self.most))

    def join(self, other: _Group) -> None:
        self.paths |= other.paths
        self.least, self.exact = max(self.least, other.least), max(self.exact, other.exact)
        self.most = min(self.most, other.most)


@dataclass(slots=True)
class _Needs:
    groups: list[_Group] = field(default_factory=list)
    variables: dict[str, str | None] = field(default_factory=dict)
    """The paths of messages and of elements of lists."""

    def of_route(self, checked: CheckedRoute) -> None:
        self.variables = dict.fromkeys((tree.MESSAGE, tree.ITEMS), checked.case.name)
        collect = checked.collect
        for node in (collect.by, collect.count, collect.order) if collect else ():
            self._of_node(node)
        if checked.order is not None:
            self._of_node(checked.order.number)
        for target in checked.targets:
            if target.when is not None:
                self._of_node(target.when)
            if target.plan is not None:
                self._of_plan(target.plan)
        if checked.obeyed is not None:
            self.variables = {tree.MESSAGE: checked.obeyed.case.name}
            self._of_node(checked.obeyed.when)

    def _of_plan(self, plan: Plan) -> None:
        match plan:
            case Record():
                for _, member in plan.members:
                    self._of_plan(member)
            case Items():
                for item in plan.items:
                    self._of_plan(item)
            case Leaf():
                self._of_node(plan.node)
            case Each():
                for _, values in plan.lists:
                    self._of_node(values)
                self._combine(plan.lists, exact=plan.type.length or 0, most=_most(plan.type))
                self._of_plan(plan.element)

    def _of_node(self, node: tree.Node) -> None:
        if isinstance(node, tree.Each):
            self._combine(node.lists)
        elif isinstance(node, tree.Element):
            self._add(self._lists(node.values), _Group(set(), least=node.index + 1))
        for part in tree.parts_of(node):
            self._of_node(part)

    def _combine(self, lists: Sequence[tuple[str, tree.Node]], exact: int = 0, most: int = sys.maxsize) -> None:
        self.variables |= {name: self._path(values) for name, values in lists}
        groups = (group for _, values in lists for group in self._lists(values))
        self._add(groups, _Group(set(), most=most, exact=exact))

    def _add(self, groups: Iterable[_Group], need: _Group) -> None:
        for group in groups:
            need.join(group)
        apart = []
        for group in self.groups:
            if group.paths & need.paths:
                need.join(group)
            else:
                apart.append(group)
        self.groups = [*apart, need]

    def _lists(self, node: tree.Node) -> Iterator[_Group]:
        """Yield the lists of the payload that make up a list."""
        match node:
            case tree.Read():
                if (path := self._path(node)) is not None:
                    yield _Group({path}, most=_most(node.field.type))
            case tree.Choice():
                yield from self._lists(node.body)
                yield from self._lists(node.orelse)
            case tree.Each():
                for _, values in node.lists:
                    yield from self._lists(values)

    def _path(self, node: tree.Node) -> str | None:
        """Return the path of a field; all elements of a list have the same one. None for computed values."""
        match node:
            case tree.Variable():
                return self.variables.get(node.name)
            case tree.Element():
                return self._path(node.values)
            case tree.Read():
                holder = self._path(node.holder)
                return f"{holder}.{node.field.name}" if holder is not None else None
        return None


def _most(declared: object) -> int:
    """Return the largest number of elements that a list or bytes can hold."""
    bound = declared.bound if isinstance(declared, (List, Bytes)) else None
    return sys.maxsize if bound is None else bound
