"""The inputs of a compile: files, folders, links and variables. An open recording notes each as it is read.

A compile reads its inputs only through the functions here. If descriptors or memory have run out, they raise
StartError, so that this is not taken for a mistake in a file. A kept program is used if none of its inputs has changed
(`changed`). A file with the same inode, size and times is unchanged, as for git; where these cannot tell, its content
is compared by a digest. A start does that before it imports large modules, so this module imports only small ones.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from time import time_ns
from zlib import crc32

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    Value: TypeAlias = tuple[object, ...]
    Stamp: TypeAlias = tuple[int, ...]
    """Size, times (ns) and inode of a file."""
    Plain: TypeAlias = tuple[tuple[str, str, Value, Stamp | None], ...]
    """(kind, name, value, stamp) of each input, sorted. The stamp is None if it may miss a change."""
    Listing: TypeAlias = tuple[tuple[str, ...], tuple[str, ...]]
    """The folders and the other files in a folder, sorted."""

_PACKAGE = os.path.dirname(os.path.abspath(__file__))
_ASSETS = "_assets"
_SCHEMAS = [os.path.join(place, "schemas") for place in (os.path.join(_PACKAGE, _ASSETS), os.path.dirname(_PACKAGE))]
"""The schema folders of an installation and of a checkout. They are read once, like the code."""
_ABSENT = frozenset({2, 9, 20, 40})  # ENOENT, EBADF, ENOTDIR, ELOOP
_CODE = (".py", ".so", ".json", ".html", ".xml")
_OF_ROS = ("AMENT_", "RMW_", "ROS_")
_UNSTEADY = ("changed while it was read",)
_SECOND = 1_000_000_000
_TICK = 2 * _SECOND
"""Time (ns) within which two writes may leave the same times: far more than a tick of a kernel or a file server."""
_HAS_FOLDER_OF_COMMAND = not (sys.flags.isolated or getattr(sys.flags, "safe_path", False))
"""Whether `sys.path` starts with the command's folder, which depends on how the command was started."""


class Inputs:
    """The inputs that were read, with their values."""

    def __init__(self) -> None:
        self._noted: dict[tuple[str, str], tuple[Value, Stamp | None]] = {}
        try:
            self._folder = os.getcwd()
        except FileNotFoundError:  # the folder was deleted: no relative path can be resolved
            self._folder = ""

    def plain(self) -> Plain:
        """Return all inputs as plain values for `marshal`."""
        return tuple((*key, *self._noted[key]) for key in sorted(self._noted))

    def note(self, kind: str, name: str, *value: object, stamp: Stamp | None = None) -> None:
        """Note a value, or more of one that was noted before. If it has changed, note one that never matches."""
        if kind in ("file", "folder", "link"):
            name = os.path.join(self._folder, name)
        before, earlier = self._noted.get((kind, name), ((), None))
        shorter, longer = sorted((before, value), key=len)
        if longer[: len(shorter)] == shorter:
            self._noted[kind, name] = longer, stamp or earlier
        else:
            self._noted[kind, name] = _UNSTEADY, None

    def add(self, other: Inputs) -> None:
        """Add all inputs of `other`."""
        for (kind, name), (value, stamp) in other._noted.items():
            self.note(kind, name, *value, stamp=stamp)

    def read_again(self) -> bool:
        """Return whether no input has changed. If so, note all of them in the open recording."""
        if changed(self.plain()):
            return False
        if (outer := _open.get()) is not None:
            outer.add(self)
        return True


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
    """Return the first input that has changed, in words; "" if none has."""
    for kind, name, value, stamp in plain:
        if (stamp is None or stamp != _stamp(name)) and _value(kind, name, is_read=len(value) > 1) != value:
            return name if kind == "process" else f"the {kind} {name}"
    return ""


def are_same(one: Plain, other: Plain) -> bool:
    """Return whether two compiles read the same, whenever the files were written."""
    return [item[:-1] for item in one] == [item[:-1] for item in other]


def read_bytes(path: str | os.PathLike[str], most: int = -1) -> bytes:
    """Return the content of a file, or its first `most` bytes. Raises OSError, or ValueError for an impossible path."""
    name = os.fspath(path)
    now = time_ns()
    try:
        with open(name, "rb") as stream:
            stamp = _stamp(stream.fileno())  # before the content, which is then at least as new
            content = stream.read(most)
    except OSError as error:
        _check_shortage(error)
        _note("file", name, *(("",) if error.errno in _ABSENT else ("file", error.errno)))
        raise
    _note("file", name, "file", _digest(content), stamp=stamp if stamp and _is_settled(stamp, now) else None)
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


def _noted_kind(path: str | os.PathLike[str]) -> object:
    name = os.fspath(path)
    (kind,) = _look(name, is_read=False)
    _note("file", name, kind)
    if isinstance(kind, int):
        error = OSError(kind, os.strerror(kind), name)
        _check_shortage(error)
        raise error
    return kind


def listing(path: str | os.PathLike[str]) -> Listing:
    """Return the folders and the other files in a folder, without hidden ones. Empty if it cannot be read."""
    name = os.fspath(path)
    try:
        found = _listing(name)
    except OSError as error:
        _check_shortage(error)
        _note("folder", name, error.errno)
        return (), ()
    _note("folder", name, *found)
    return found


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
    """The environment variables of the process. Notes each one whose value is read."""

    def __getitem__(self, name: str) -> str:
        value = os.environ.get(name)
        _note("variable", name, value)
        if value is None:
            raise KeyError(name)
        return value

    def __iter__(self) -> Iterator[str]:
        """Yield all names. They are not noted: only the hints of errors need them, and then no program is kept."""
        return iter(sorted(os.environ))

    def __len__(self) -> int:
        return len(os.environ)


ENVIRONMENT = _Environment()


def _note(kind: str, name: str, *value: object, stamp: Stamp | None = None) -> None:
    inputs = _open.get()
    if inputs is not None:
        inputs.note(kind, name, *value, stamp=stamp)


def _value(kind: str, name: str, *, is_read: bool) -> Value:
    if kind == "file":
        return _look(name, is_read=is_read)
    if kind == "folder":
        try:
            return _listing(name)
        except OSError as error:
            return (error.errno,)
    if kind == "link":
        return (os.path.realpath(name),)
    return (os.environ.get(name) if kind == "variable" else _process().get(name),)


def _look(path: str, *, is_read: bool) -> Value:
    """Return what is there: "file", "folder", "other" or "" (nothing); an errno if that is unknown.

    If a file is read, a digest of its content follows, or an errno.
    """
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        return ("" if error.errno in _ABSENT else error.errno,)
    except ValueError:  # no file system accepts such a path
        return ("",)
    kind = "folder" if stat.S_ISDIR(mode) else "file" if stat.S_ISREG(mode) else "other"
    if not is_read or kind != "file":  # reading a pipe may block
        return (kind,)
    try:
        with open(path, "rb") as stream:
            return kind, _digest(stream.read())
    except OSError as error:
        return kind, error.errno


def _listing(path: str) -> Listing:
    with os.scandir(path) as entries:
        found = sorted((entry.name, entry.is_dir()) for entry in entries if not entry.name.startswith("."))
    folders, others = (tuple(name for name, is_folder in found if is_folder is wanted) for wanted in (True, False))
    return folders, others


def _digest(content: bytes) -> int:
    """Return size and CRC-32. They miss one in 2**32 edits that keep the size, and only where times do not tell."""
    return len(content) << 32 | crc32(content)


def _stamp(file: str | int) -> Stamp | None:
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def _is_settled(stamp: Stamp, now: int) -> bool:
    """Return whether every write after `now` (ns) changes the stamp.

    Not if the file was just written, or later than `now` because the clock was set back. Nor if the file system has
    whole seconds, such as squashfs and FAT: all files of its images may have the same time.
    """
    _, modified, changed, _ = stamp
    return max(modified, changed) < now - _TICK and changed % _SECOND != 0


@cache
def _process() -> Mapping[str, object]:
    """Return what identifies the code of this process: Python, router and packages, and the variables of ROS.

    Computed once, because the process imports each module only once.
    """
    code = sorted(path for folder in (_PACKAGE, *_SCHEMAS) for path in _code_below(folder))
    packages = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    return {
        "Python": (sys.version, sys.executable, sys.prefix, tuple(sys.path[_HAS_FOLDER_OF_COMMAND:])),
        "the router's code": _times(code),
        "a variable of ROS": tuple(sorted(item for item in os.environ.items() if item[0].startswith(_OF_ROS))),
        "an installed package": _times(packages),
    }


def _times(paths: Sequence[str]) -> int:
    """Return a digest of the sizes and times of files whose contents take too long to read."""
    return _digest(ascii([(path, (_stamp(path) or ())[:3]) for path in paths]).encode())


def _code_below(folder: str) -> Iterator[str]:
    try:
        entries = [*os.scandir(folder)]
    except OSError:
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            if entry.name not in ("__pycache__", _ASSETS):
                yield from _code_below(entry.path)
        elif entry.name.endswith(_CODE):
            yield entry.path
