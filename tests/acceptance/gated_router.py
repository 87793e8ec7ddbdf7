"""`python -m router`, which stops before it imports the verbs for as long as the file $GATE exists.

By then the head start is done and its threads run. The file $GATE.reached appears when the process waits.
"""

from __future__ import annotations

import os
import runpy
import sys
import time


class Gate:
    def find_spec(self, name: str, *_: object) -> None:
        gate = os.environ["GATE"]
        if name == "router.cli" and os.path.exists(gate):  # noqa: PTH110 - pathlib is not small
            os.close(os.open(f"{gate}.reached", os.O_CREAT | os.O_WRONLY))
            while os.path.exists(gate):  # noqa: PTH110
                time.sleep(0.002)


if __name__ == "__main__":
    sys.meta_path.insert(0, Gate())
    runpy.run_module("router", run_name="__main__", alter_sys=True)
