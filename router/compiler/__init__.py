"""Compiles a route table: from a RouteTable and the types to findings or a Program."""

from __future__ import annotations

from router.compiler.check import Checked, check_table
from router.compiler.compiled_table import STRANGER, source_label

__all__ = ["check_table", "Checked", "STRANGER", "source_label"]
