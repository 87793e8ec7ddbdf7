"""`python -m demo.tied MODULE ARGUMENT...` is `python -m MODULE ARGUMENT...`, killed when its parent dies.

The kernel does that (PR_SET_PDEATHSIG), so it works even if the parent gets SIGKILL.
"""

from __future__ import annotations

import ctypes
import runpy
import signal
import sys

PR_SET_PDEATHSIG = 1


def main() -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
