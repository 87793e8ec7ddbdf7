"""Puts the carrier's library into a wheel, which is then for one platform and any Python.

Without a C compiler the wheel has none, only what its headers declare, and is for any platform: nothing runs by it.
"""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

LIBRARY = "router/carrier/native/libcarrier.so"
DECLARED = "router/declared.py"


class CarrierBuildHook(BuildHookInterface):  # type: ignore[type-arg]  # what it is generic in is said nowhere
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":  # `make setup` builds the library of a checkout
            return
        self._folder = TemporaryDirectory(prefix="carrier")
        library = Path(self._folder.name) / Path(LIBRARY).name
        # The sources say with what they are compiled, and import nothing that a build environment lacks.
        build = Path(self.root) / "router" / "carrier" / "build.py"
        done = subprocess.run(
            [sys.executable, build, "--output", library], stderr=subprocess.PIPE, text=True, check=False
        )
        declared = library.with_name(Path(DECLARED).name)
        if declared.exists():
            build_data["force_include"][str(declared)] = DECLARED
        if done.returncode:
            self.app.display_warning(f"the wheel lacks the carrier's library\n{done.stderr}")
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
        build_data["force_include"][str(library)] = LIBRARY

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        if version != "editable":
            self._folder.cleanup()
