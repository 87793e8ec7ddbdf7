"""Puts the carrier's library and the protos of `routes/` into a wheel, which is for one platform and any Python.

Without a C compiler the wheel has no library, only what its headers declare, and is for any platform: nothing runs by
it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

LIBRARY = "router/carrier/native/libcarrier.so"
DECLARED = "router/declared.py"
ASSETS = "router/_assets"
LOCK = "envelope.lock.json"


class UnshippableError(Exception):
    """Protos that a table names, and a wheel cannot hold."""


def protos_of_tables(root: Path) -> Iterator[Path]:
    """The files, relative to `root`, that the tables of `routes/` name as protos and locks. Raises UnshippableError."""
    for table in sorted((root / "routes").glob("*.y*ml")):
        try:
            content = yaml.safe_load(table.read_bytes())
        except yaml.YAMLError as error:
            raise UnshippableError(f"routes/{table.name} cannot be read: {error}") from error
        if not isinstance(content, dict) or not isinstance(envelope := content.get("envelope"), dict):
            continue  # tests, and tables that extend another one
        folder = _inside(root, table, envelope.get("protos", "../protos"))
        found = [path.relative_to(root) for path in folder.rglob("*") if _belongs_to_protos(path)]
        if not any(path.suffix == ".proto" for path in found):
            what = f"routes/{table.name} takes its protos from {folder.relative_to(root)}, which holds no .proto file"
            raise UnshippableError(f"{what}; if that is a submodule, run `git submodule update --init`")
        yield from found
        if "lock" in envelope:
            yield _inside(root, table, envelope["lock"]).relative_to(root)


def _inside(root: Path, table: Path, written: str) -> Path:
    path = Path(os.path.normpath(table.parent / written))
    if not path.is_relative_to(root):
        what = f"routes/{table.name} names {written}, which is outside of this checkout: a wheel cannot hold it"
        raise UnshippableError(f"{what}; move it into the checkout, for example as a submodule")
    if not path.exists():
        raise UnshippableError(f"routes/{table.name} names {written}, which is not there")
    return path


def _belongs_to_protos(path: Path) -> bool:
    """A declaration, its options, the lock, or the licence of somebody else's protos."""
    return path.suffix in {".proto", ".options"} or path.name == LOCK or path.stem in {"LICENSE", "COPYING", "NOTICE"}


class CarrierBuildHook(BuildHookInterface):  # type: ignore[type-arg]  # what it is generic in is said nowhere
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":  # `make setup` builds the library of a checkout
            return
        root = Path(self.root).resolve()
        try:
            protos = [*protos_of_tables(root)]
        except UnshippableError as error:
            self.app.abort(f"no wheel was built: {error}")
        build_data["force_include"] |= {str(root / path): f"{ASSETS}/{path.as_posix()}" for path in protos}
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
