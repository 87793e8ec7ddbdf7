"""A declarative router between protobuf over UDP and ROS 2. `main` is the command `router`."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress

__version__ = "1.0.0"

NO_CACHE = "--no-cache"
"""Option of `router run`: compile the table before routing starts."""

_KEYBOARD_INTERRUPT = 130
_UNTIL_COLLECTED = 200_000
"""Threshold of garbage collection, in objects. With the default of 700, it takes a fifth of the time of `validate`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    hold_signals(arguments)
    _reopen_standard_streams()
    with ExitStack() as ending:
        try:
            if _verb(arguments) != "run":  # `run` sets up its process itself
                gc.set_threshold(_UNTIL_COLLECTED)
            elif argv is None and NO_CACHE not in arguments:
                from router.startup_image.head_start import begin

                ending.callback(begin().close)  # if the verb fails before it takes over the head start
            from router.cli import main as run_verb  # once signals are blocked, as this takes up to 1 s
        except KeyboardInterrupt:
            return _KEYBOARD_INTERRUPT
        code = run_verb(arguments)
    if argv is None and _verb(arguments) == "run":
        _exit(code)
    gc.freeze()  # otherwise Python would search all remaining objects for cycles several times before it exits
    return code


def _reopen_standard_streams() -> None:
    """Open /dev/null for each standard stream that the caller has closed, or the next socket would get its number."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: PTH123, SIM115 - for as long as we run


def _exit(code: int) -> None:
    """End the process without running exit handlers of libraries: that of Fast DDS sleeps for 0.1 s. Call it last."""
    with suppress(OSError):
        sys.stderr.flush()
    os._exit(code)


def hold_signals(arguments: Sequence[str]) -> None:
    """Block SIGHUP and SIGUSR1 for `router run`, which handles them with sigwait once it routes.

    Blocked in all threads, they run no handler and interrupt no system call. They end other verbs, as usual.
    """
    if _verb(arguments) == "run":
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP, signal.SIGUSR1})


def _verb(arguments: Sequence[str]) -> str | None:
    return next((argument for argument in arguments if not argument.startswith("-")), None)
