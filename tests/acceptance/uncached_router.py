"""`python -m router` without the cache of scrapes, because tests compare counters within KEPT_SECONDS."""

from __future__ import annotations

import runpy

from router.observe import responses

if __name__ == "__main__":
    responses.KEPT_SECONDS = 0
    runpy.run_module("router", run_name="__main__", alter_sys=True)
