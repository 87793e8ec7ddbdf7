"""A configuration-driven declarative router between protobuf over UDP and ROS 2.

Importing it imports nothing else. `main` is the command `router`.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

_KEYBOARD_INTERRUPT = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; its exit code."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    hold_signals(arguments)
    try:
        from router.cli import main as run_verb  # after the signals: what a verb imports takes up to a second
    except KeyboardInterrupt:
        return _KEYBOARD_INTERRUPT
    return run_verb(arguments)


def hold_signals(arguments: Sequence[str]) -> None:
    """Has SIGHUP and SIGUSR1 wait if these are the arguments of `router run`, which serves them once it routes.

    Blocked in all threads, signals wait for sigwait: no handler runs, no system call is interrupted. Other verbs end
    by them, as programs do when their terminal closes.
    """
    verb = next((argument for argument in arguments if not argument.startswith("-")), None)
    if verb == "run":
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP, signal.SIGUSR1})
