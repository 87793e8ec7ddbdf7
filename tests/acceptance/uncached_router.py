"""`python -m router`, but each scrape collects anew: tests compare counters at shorter distances than KEPT_SECONDS."""

from __future__ import annotations

import runpy

from router.observe import responses

if __name__ == "__main__":
    responses.KEPT_SECONDS = 0
    runpy.run_module("router", run_name="__main__", alter_sys=True)
