"""What the doctor finds: how grave it is, what it is about, and what to do."""

from __future__ import annotations

import enum
from typing import NamedTuple


class Grade(enum.Enum):
    FINE = "ok"
    WARNING = "warning"
    PROBLEM = "problem"


class Finding(NamedTuple):
    """`about` is a word; `remedy` is empty where nothing has to be done."""

    grade: Grade
    about: str
    text: str
    remedy: str = ""


def fine(about: str, text: str) -> Finding:
    return Finding(Grade.FINE, about, text)


def warning(about: str, text: str, remedy: str) -> Finding:
    """Something works worse than it could, or will not work for somebody."""
    return Finding(Grade.WARNING, about, text, remedy)


def problem(about: str, text: str, remedy: str) -> Finding:
    """The router does not start, or what the table wants does not happen."""
    return Finding(Grade.PROBLEM, about, text, remedy)
