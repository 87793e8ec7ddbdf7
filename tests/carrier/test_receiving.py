"""What the receive thread does when the kernel fails to hand over a datagram."""

from __future__ import annotations

from pathlib import Path

from tests.carrier.building import run_program


def test_failures_are_tried_again_paused_after_and_never_taken_for_an_empty_queue(tmp_path: Path) -> None:
    run_program("receiving", tmp_path)
