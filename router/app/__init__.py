"""The running router: opens what a program needs, reloads the table, and shuts down cleanly."""

from router.app.process import tune_interpreter
from router.app.router import Router

__all__ = ["Router", "tune_interpreter"]
