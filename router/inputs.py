"""The inputs of a compile: files, folders, links and variables. An open recording notes each with its value.

A compile reads its inputs only through the functions here. If descriptors or memory have run out, they raise
StartError, so that this is not taken for a mistake in a file. A kept program is used if all of its inputs still have
the same values (`changed`). A start checks them before it imports large modules, so this module imports only small
ones.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    Plain: TypeAlias = tuple[tuple[str, str, object], ...]
    """(kind, name, value) of each input, sorted. If the value cannot be read, it is the errno."""
    Listing: TypeAlias = tuple[tuple[str, ...], tuple[str, ...]]
    """The folders and the other files in a folder, sorted."""

_PACKAGE = os.path.dirname(os.path.abspath(__file__))
_ASSETS = "_assets"
_SCHEMAS = [os.path.join(place, "schemas") for place in (os.path.join(_PACKAGE, _ASSETS), os.path.dirname(_PACKAGE))]
"""The schema folders of an installation and of a checkout. They are read once, like the code."""
_ABSENT = frozenset({2, 9, 20, 40})  # ENOENT, EBADF, ENOTDIR, ELOOP
_CODE = (".py", ".so", ".json", ".html", ".xml")
_OF_ROS = ("AMENT_", "RMW_", "ROS_")
_UNSTEADY = "changed while it was read"
_HAS_FOLDER_OF_COMMAND = not (sys.flags.isolated or getattr(sys.flags, "safe_path", False))
"""Whether `sys.path` starts with the command's folder, which depends on how the command was started."""


class Inputs:
    """The inputs that were read, with their values."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, str], object] = {}
        try:
            self._folder = os.getcwd()
        except FileNotFoundError:  # the folder was deleted: no relative path can be resolved
            self._folder = ""

    def plain(self) -> Plain:
        """Return all inputs as plain values for `marshal`. Compiles that read the same inputs get equal values."""
        return tuple((kind, name, value) for (kind, name), value in sorted(self._values.items(), key=_key))

    def note(self, kind: str, name: str, value: object) -> None:
        """Note a value. An input whose value changed during the recording is noted with one that never matches."""
        if kind in _OF_FILES:
            name = os.path.join(self._folder, name)
        before = self._values.setdefault((kind, name), value)
        if before != value:
            self._values[kind, name] = _UNSTEADY

    def add(self, other: Inputs) -> None:
        """Add all inputs of `other`."""
        for (kind, name), value in other._values.items():
            self.note(kind, name, value)

    def read_again(self) -> bool:
        """Read all inputs again. Return whether no value has changed; if so, note them in the open recording."""
        if any(_PROBES[kind](name) != value for (kind, name), value in self._values.items()):
            return False
        if (outer := _open.get()) is not None:
            outer.add(self)
        return True


def _key(item: tuple[tuple[str, str], object]) -> tuple[str, str]:
    return item[0]


_open: ContextVar[Inputs | None] = ContextVar("inputs", default=None)


@contextmanager
def noted() -> Iterator[Inputs]:
    """Note what this thread reads, here and in the enclosing recording."""
    outer, inner = _open.get(), Inputs()
    token = _open.set(inner)
    try:
        yield inner
    finally:
        _open.reset(token)
        if outer is not None:
            outer.add(inner)


@contextmanager
def recording(before: Inputs | None = None) -> Iterator[Inputs]:
    """Note what this thread reads, what was read `before`, the installation, and the variables of ROS."""
    with noted() as inputs:
        for name, value in _process().items():
            inputs.note("process", name, value)
        if before is not None:
            inputs.add(before)
        yield inputs


def changed(plain: Plain) -> str:
    """Return the first input whose value has changed, in words; "" if none has."""
    for kind, name, value in plain:
        if _PROBES[kind](name) != value:
            return _WORDS[kind].format(name)
    return ""


def read_bytes(path: str | os.PathLike[str], most: int = -1) -> bytes:
    """Return the content of a file, or its first `most` bytes. Raises OSError, or ValueError for an impossible path."""
    name = os.fspath(path)
    try:
        with open(name, "rb") as stream:
            content = stream.read(most)
    except OSError as error:
        _check_shortage(error)
        _note("file", name, error.errno)
        raise
    _note("file", name, content)
    return content


def read_text(path: str | os.PathLike[str]) -> str:
    """Read a UTF-8 file with universal newlines. Raises OSError or UnicodeDecodeError."""
    return read_bytes(path).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


def is_file(path: str | os.PathLike[str]) -> bool:
    """Return whether the path is a regular file. Raises OSError if it cannot be examined."""
    return _noted_kind(path) == "file"


def is_dir(path: str | os.PathLike[str]) -> bool:
    """Return whether the path is a folder. Raises OSError if it cannot be examined."""
    return _noted_kind(path) == "folder"


def exists(path: str | os.PathLike[str]) -> bool:
    """Return whether the path exists. Raises OSError if it cannot be examined."""
    return _noted_kind(path) != ""


def _noted_kind(path: str | os.PathLike[str]) -> str:
    name = os.fspath(path)
    kind = _kind(name)
    error = OSError(kind, os.strerror(kind), name) if isinstance(kind, int) else None
    if error is not None:
        _check_shortage(error)
    _note("kind", name, kind)
    if error is not None:
        raise error
    return str(kind)


def listing(path: str | os.PathLike[str]) -> Listing:
    """Return the folders and the other files in a folder, without hidden ones. Empty if it cannot be read."""
    name = os.fspath(path)
    found = _listing(name)
    if isinstance(found, int):
        _check_shortage(OSError(found, os.strerror(found), name))
    _note("folder", name, found)
    return ((), ()) if isinstance(found, int) else found


def _check_shortage(error: OSError) -> None:
    """Raise StartError if something has run out."""
    from router.shortage import is_shortage

    if is_shortage(error):
        from router.errors import StartError

        raise StartError(f"{error.filename} cannot be read now: {error.strerror}") from error


def real_path(path: str | os.PathLike[str]) -> str:
    """Return the absolute path without links; it need not exist."""
    name = os.fspath(path)
    real = os.path.realpath(name)
    _note("link", name, real)
    return real


class _Environment(Mapping[str, str]):
    """The environment variables of the process. Notes each one that is read."""

    def __getitem__(self, name: str) -> str:
        value = os.environ.get(name)
        _note("variable", name, value)
        if value is None:
            raise KeyError(name)
        return value

    def __iter__(self) -> Iterator[str]:
        names = tuple(sorted(os.environ))
        _note("names", "", names)
        return iter(names)

    def __len__(self) -> int:
        return len(os.environ)


ENVIRONMENT = _Environment()


def _note(kind: str, name: str, value: object) -> None:
    inputs = _open.get()
    if inputs is not None:
        inputs.note(kind, name, value)


def _content(path: str) -> bytes | int | None:
    """Return the content of a file, or errno; None unless it is a regular file, as reading others may block."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                return None
            with open(descriptor, "rb", buffering=0, closefd=False) as stream:
                return stream.read()
        finally:
            os.close(descriptor)
    except OSError as error:
        return error.errno


def _kind(path: str) -> str | int:
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        return "" if error.errno in _ABSENT else error.errno or 0
    except ValueError:  # no file system accepts such a path
        return ""
    return "folder" if stat.S_ISDIR(mode) else "file" if stat.S_ISREG(mode) else "other"


def _listing(path: str) -> Listing | int:
    try:
        with os.scandir(path) as entries:
            found = sorted((entry.name, entry.is_dir()) for entry in entries if not entry.name.startswith("."))
    except OSError as error:
        return error.errno or 0
    folders, others = (tuple(name for name, is_folder in found if is_folder is wanted) for wanted in (True, False))
    return folders, others


@cache
def _process() -> Mapping[str, object]:
    """Return what identifies the code of this process: Python, router and packages, and the variables of ROS.

    Computed once, because the process imports each module only once.
    """
    from router.declared import CHECKSUM

    packages = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    return {
        "Python": (sys.version, sys.executable, sys.prefix, tuple(sys.path[_HAS_FOLDER_OF_COMMAND:])),
        "the router's C library": CHECKSUM,
        "the router's code": tuple(sorted(each for place in (_PACKAGE, *_SCHEMAS) for each in _stamps(place))),
        "a variable of ROS": tuple(sorted(each for each in os.environ.items() if each[0].startswith(_OF_ROS))),
        "an installed package": tuple((path, _stamp(os.stat(path))) for path in packages if os.path.isdir(path)),
    }


def _stamps(folder: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield each code file below a folder with its times (ns) and size, which change when it is written."""
    try:
        entries = [*os.scandir(folder)]
    except OSError:
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            if entry.name not in ("__pycache__", _ASSETS):
                yield from _stamps(entry.path)
        elif entry.name.endswith(_CODE):
            with suppress(FileNotFoundError):  # it was just removed
                yield entry.path, _stamp(entry.stat(follow_symlinks=False))


def _stamp(status: os.stat_result) -> tuple[int, ...]:
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size


_OF_FILES = frozenset({"file", "kind", "folder", "link"})
_PROBES: Mapping[str, Callable[[str], object]] = {
    "file": _content,
    "kind": _kind,
    "folder": _listing,
    "link": os.path.realpath,
    "variable": os.environ.get,
    "names": lambda _: tuple(sorted(os.environ)),
    "process": lambda name: _process().get(name),
}
_WORDS: Mapping[str, str] = {
    "file": "the file {}",
    "kind": "the file {}",
    "folder": "the folder {}",
    "link": "where the path {} leads",
    "variable": "the variable {}",
    "names": "the set of variables",
    "process": "{}",
}
