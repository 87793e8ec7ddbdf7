"""Compiles the carrier's library, and generates `router/declared.py` from its headers.

Needs only a C compiler, not even the router's dependencies:

python router/carrier/build.py              compile with `$CC`, by default `cc`
python router/carrier/build.py --output F   to another file, with `declared.py` beside it
python router/carrier/build.py --rcl        fail without the rcl headers that check rcl_types.h
python router/carrier/build.py --check      exit with 0 if the library is up to date, else 1
python router/carrier/build.py --lint       only check for compiler warnings; exit with 0 if none
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from hashlib import sha256
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from tempfile import TemporaryDirectory

NATIVE = Path(__file__).parent / "native"
LIBRARY = NATIVE / "libcarrier.so"
DECLARED = NATIVE.parents[1] / "declared.py"
"""The declarations of the headers, for Python."""

_OPTIMIZED = (
    "-O2",
    "-fno-semantic-interposition",
    "-fstack-protector-strong",
    "-U_FORTIFY_SOURCE",
    "-D_FORTIFY_SOURCE=2",
)
_LINKED = ("-Wl,-Bsymbolic", "-Wl,-z,defs", "-Wl,-z,relro", "-Wl,-z,now", "-Wl,-z,noexecstack")
"""All functions are exported for ctypes; calls among them bypass the symbol table."""

_RCL = ("rcl", "rcutils", "rmw", "rosidl_runtime_c", "rosidl_typesupport_interface", "rosidl_dynamic_typesupport",
        "rcl_yaml_param_parser", "type_description_interfaces", "service_msgs", "builtin_interfaces")  # fmt: skip
"""Packages whose headers rcl includes."""

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wstrict-prototypes", "-Werror")
"""For developers only: other compilers may warn about more."""


class BuildError(Exception):
    """There is no compiler, the sources do not compile (with the compiler's output), or Python has 32 bits."""


def sources() -> list[Path]:
    """Return the files to compile."""
    return sorted(NATIVE.glob("*.c"))


def rcl_headers() -> list[str]:
    """Return compiler options for the headers of rcl, from the wheels in this environment or from ROS packages of apt.

    Empty without rcl.
    """
    folders = [Path(prefix, "include", package) for prefix in _prefixes() for package in _RCL]
    is_there = any((folder / "rcl" / "types.h").exists() for folder in folders)
    return [f"-isystem{folder}" for folder in folders if folder.is_dir()] if is_there else []


def _prefixes() -> list[str]:
    return [sys.prefix, *filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))]


def checksum() -> str:
    """Return the SHA-256 of everything that determines the library: processor, sources, headers, and the build scripts.

    `carrier_checksum` returns it, and `router.declared` contains it.
    """
    digest = sha256(platform.machine().encode())
    for path in [*sorted(NATIVE.glob("*.[ch]")), Path(__file__), Path(__file__).with_name("headers.py")]:
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def is_current(library: Path = LIBRARY) -> bool:
    """Return whether the library was built from the present files. Does not load it."""
    current = checksum().encode()
    return all(made.exists() and current in made.read_bytes() for made in (library, declared_by(library)))


def declared_by(library: Path) -> Path:
    """Return the Python module that is generated together with a library."""
    return DECLARED if library == LIBRARY else library.with_name(DECLARED.name)


def build(output: Path = LIBRARY, flags: Sequence[str] = _OPTIMIZED + _LINKED, compiler: str | None = None) -> Path:
    """Compile the library and replace `output` atomically: a running router keeps the one that it has loaded.

    The Python module is generated first, even without a compiler. Raises BuildError.
    """
    if sys.maxsize < 2**32:
        raise BuildError("the carrier is for 64-bit processors only, but this Python is for 32-bit ones")
    with TemporaryDirectory(dir=output.parent, prefix=".carrier") as folder:
        made, checks = Path(folder) / output.name, _declare(output, Path(folder))
        files = [*map(str, sources()), str(checks), f"-I{NATIVE}"]
        compile_c([*files, "-fPIC", "-shared", *rcl_headers(), *flags, "-o", str(made)], compiler)
        made.replace(output)
    return output


def _declare(library: Path, folder: Path) -> Path:
    """Generate the module of a library. Return a C file in `folder` that checks the module at compile time.

    Raises BuildError.
    """
    from router.carrier.headers import HeaderError, checks, declarations

    made = folder / DECLARED.name
    try:
        made.write_text(declarations(NATIVE, checksum()), encoding="utf-8")
    except HeaderError as error:
        raise BuildError(str(error)) from None
    spec = spec_from_file_location("declared", made)
    assert spec is not None and spec.loader is not None  # noqa: S101, PT018 - it is a Python file
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    checked = folder / "declared.c"
    checked.write_text(checks(NATIVE, module), encoding="utf-8")
    made.replace(declared_by(library))
    return checked


def compile_c(arguments: Sequence[str], compiler: str | None = None) -> None:
    """Run the C compiler on sources of the carrier or of its callers. Raises BuildError."""
    language = ("-std=c11", "-D_GNU_SOURCE", "-pthread", f'-DCARRIER_CHECKSUM="{checksum()}"')
    libraries = () if {"-fsyntax-only", "-c"} & {*arguments} else ("-lm",)
    command = [compiler or os.environ.get("CC") or "cc", *language, *arguments, *libraries]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    except OSError as error:
        raise BuildError(f"the C compiler '{command[0]}' cannot be run: {error.strerror}") from None
    if done.returncode:
        raise BuildError(f"{' '.join(command)}\n{done.stderr.rstrip()}")


def main() -> int:
    parser = argparse.ArgumentParser(description="Compile the carrier's library.")
    parser.add_argument("--output", type=Path, default=LIBRARY)
    parser.add_argument("--rcl", action="store_true", help="fail without the rcl headers that check rcl_types.h")
    parser.add_argument("--check", action="store_true", help="only report by the exit code whether it is up to date")
    parser.add_argument("--lint", action="store_true", help="only check for compiler warnings")
    args = parser.parse_args()
    if args.check:
        return 0 if is_current(args.output) else 1
    places = " or ".join(f"{prefix}/include" for prefix in _prefixes())
    unchecked = "" if rcl_headers() else f"rcl_types.h was not checked: there are no headers of rcl in {places}"
    try:
        if args.rcl and unchecked:
            raise BuildError(unchecked)
        if args.lint:
            compile_c([*map(str, sources()), *rcl_headers(), *WARNINGS, "-fsyntax-only"])
        else:
            build(args.output)
    except BuildError as error:
        print(f"build: {error}", file=sys.stderr)
        return 1
    if unchecked:
        print(f"build: {unchecked}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    sys.exit(main())
