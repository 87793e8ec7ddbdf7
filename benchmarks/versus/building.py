"""The C and C++ programs of benchmarks/peer: what they need, and building them. Knows nothing of what they do."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.tables import PROTOS

ROOT = Path(__file__).parents[2]
PEER = ROOT / "benchmarks" / "peer"
PROGRAMS = ROOT / "build" / "bench"
_MADE = PROGRAMS / "made"

_NEEDED = {
    "gcc": "gcc",
    "g++": "g++",
    "ss": "iproute2",
    "/usr/bin/protoc": "protobuf-compiler",
    "/usr/include/google/protobuf/message.h": "libprotobuf-dev",
}
"""What must be there, and the Debian package that has it."""


def missing_packages() -> list[str]:
    """Debian packages without which the programs cannot be built."""
    return [package for needed, package in _NEEDED.items() if not (Path(needed).exists() or shutil.which(needed))]


def _checksum() -> str:
    """Of everything that the programs are made from."""
    folders = (PEER, PROTOS, ROOT / "schemas" / "comms")
    made_from = hashlib.sha256(sys.prefix.encode())
    for path in sorted(path for folder in folders for path in folder.rglob("*") if path.is_file()):
        made_from.update(path.read_bytes())
    return made_from.hexdigest()


def build() -> None:
    """Builds what is not up to date. Ends this program where something is missing for it."""
    checksum = _checksum()
    if _MADE.exists() and _MADE.read_text() == checksum:
        return
    if missing := missing_packages():
        packages = " ".join(missing)
        sys.exit(f"the benchmark's programs cannot be built; on Debian or Ubuntu:\n  apt-get install {packages}")
    PROGRAMS.mkdir(parents=True, exist_ok=True)
    # Where ROS is installed, its set-up names the places; the wheels' is that of this interpreter.
    prefixes = (sys.prefix, *filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
    if subprocess.run([PEER / "build.sh", PROGRAMS, *dict.fromkeys(prefixes)], check=False).returncode:
        sys.exit("the benchmark's programs could not be built; above is what the compiler says")
    _MADE.write_text(checksum)
