"""The files of startup images: one per command line, folder and Python; written atomically, private to their owner.

A file is a header and plain values in the format of `marshal`. A complete file of this user is trusted.
"""

from __future__ import annotations

import errno
import marshal
import os
import stat
import struct
import sys
import time
import zlib
from contextlib import suppress

from router import inputs
from router.image.image import Image

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import TypeAlias

    from router.inputs import Plain

    Identity: TypeAlias = tuple[tuple[str, ...], str, str]
    """Command line, folder and Python."""

CHANGED = " has changed"
"""The reason ends like this if a table or another input was edited, which is normal."""

_MOST = 4
"""Maximum number of files that are kept."""
_ENDING = ".program"
_UNFINISHED = ".new"
_TRIES = ".tries"
_MOST_TRIES = 15
"""Failed starts in quick succession after which a file is not used; systemd allows 20."""
_STALE = 60.0
"""Seconds after which an unfinished file is deleted, and failed starts are forgotten."""

_MAGIC = b"rover router kept program\n"
_FORMAT = 1
_HEAD = struct.Struct(f"<{len(_MAGIC)}sIIQ")
"""The magic, the format, Python's version, the size of the values. A checksum of everything else follows."""
_CHECKSUM = struct.Struct("<I")


class Stored:
    """The content of a complete file, written at `written` (wall clock, s): an image, compiled from `inputs`."""

    def __init__(self, identity: Identity, written: float, read: Plain, image: Image) -> None:
        self.identity = identity
        self.written = written
        self.inputs = read
        self.image = image


class _UnusableError(Exception):
    """A file cannot be used; the message says why."""


_OF_ANOTHER = "it belongs to another command line, folder or Python"


def find() -> tuple[Stored | None, str]:
    """Return the kept program of this command line, folder and Python, or why it is not used ("" if there is none)."""
    try:
        stored, why = _inspect(_path(_identity()))
        if stored is not None and stored.identity != _identity():
            return None, _OF_ANOTHER
    except FileNotFoundError:
        return None, ""
    except Exception as error:  # noqa: BLE001 - after any error, the router starts without the file
        return None, f"it cannot be read: {error!r}"
    return (None, why) if why else (stored, "")


def list_files() -> Iterator[tuple[str, Stored | None, str]]:
    """Yield, newest first, each file's path, its content if complete, and why a start does not use it, or "".

    Raises OSError.
    """
    for _, path in sorted(_files(folder(), _ENDING), reverse=True):
        try:
            content = _inspect(path)
        except FileNotFoundError:  # a router has just removed it
            continue
        yield path, *content


def _inspect(path: str) -> tuple[Stored | None, str]:
    """Return the content of a complete file, and why a start does not use it, or "". Raises OSError."""
    try:
        stored = _read(path)
    except _UnusableError as error:
        return None, str(error)
    change = inputs.changed(stored.inputs)
    return stored, f"{change}{CHANGED}" if change else ""


def write(read: Plain, image: Image) -> None:
    """Store an image for this command line, folder and Python.

    Raises OSError, also if an input has changed since it was read; then the earlier file remains.
    """
    if change := inputs.changed(read):
        raise OSError(f"{change} has changed meanwhile")
    path = _path(_identity())
    place = os.path.dirname(path)
    os.makedirs(place, mode=0o700, exist_ok=True)
    if os.stat(place).st_uid != os.geteuid():
        raise PermissionError(errno.EPERM, "the folder belongs to another user", place)
    os.chmod(place, 0o700)
    _remove_unfinished(place)
    values = marshal.dumps((_identity(), read, image.parts()))  # type: ignore[arg-type]  # which are plain
    head = _HEAD.pack(_MAGIC, _FORMAT, sys.hexversion, len(values))
    unfinished = f"{path}.{os.getpid()}-{time.monotonic_ns()}{_UNFINISHED}"
    descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        with open(descriptor, "wb") as stream:
            stream.writelines((head, _CHECKSUM.pack(_crc(head, values)), values))
            stream.flush()
            os.fsync(descriptor)
        os.rename(unfinished, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(unfinished)
        raise
    clear_tries()
    _remove_oldest(place, path)


def count_try() -> str:
    """Count a start with the kept file. After too many failed ones, return why the file is not used, else ""."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    with suppress(OSError):  # where nothing can be written, starts are not counted
        descriptor = os.open(_path(_identity()) + _TRIES, flags, 0o600)
        try:
            status = os.fstat(descriptor)
            if abs(time.time() - status.st_mtime) > _STALE:
                os.ftruncate(descriptor, 0)
            elif status.st_size >= _MOST_TRIES:
                return f"the last {_MOST_TRIES} starts that used it failed"
            os.write(descriptor, b".")
        finally:
            os.close(descriptor)
    return ""


def clear_tries() -> None:
    """Reset the count of failed starts: a router has started."""
    with suppress(OSError):
        os.unlink(_path(_identity()) + _TRIES)


def _path(identity: Identity) -> str:
    """Return the file for a command line, folder and Python. Raises OSError if there is no folder for it."""
    command, *others = identity
    return os.path.join(folder(), f"{zlib.crc32(os.fsencode(chr(0).join([*command, *others]))):08x}{_ENDING}")


def folder() -> str:
    """Return the folder of the files, in the service's state directory or the user's cache. Raises OSError."""
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if os.path.isabs(state):
        return os.path.join(state, "kept")
    cache = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(cache):
        cache = os.path.join(os.path.expanduser("~"), ".cache")
    if not os.path.isabs(cache):
        raise FileNotFoundError(errno.ENOENT, "neither STATE_DIRECTORY, XDG_CACHE_HOME nor HOME is set")
    return os.path.join(cache, "rover-router")


def _identity() -> Identity:
    return tuple(sys.argv), os.getcwd(), sys.executable


def _crc(*parts: bytes | bytearray | memoryview) -> int:
    crc = 0
    for part in parts:
        crc = zlib.crc32(part, crc)
    return crc


def _read(path: str) -> Stored:
    """Read a file without mapping it: truncating a mapped file kills the process. Raises OSError or _UnusableError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _UnusableError("it is a symbolic link") from None
        raise
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise _UnusableError("it is not a regular file")
        _check_owner(status, "it")
        _check_owner(os.stat(os.path.dirname(path)), "its folder")
        stored = _parsed(descriptor, status)
    finally:
        os.close(descriptor)
    if _path(stored.identity) != path:
        raise _UnusableError(_OF_ANOTHER)
    return stored


def _parsed(descriptor: int, status: os.stat_result) -> Stored:
    """Return the content of an open file. Raises _UnusableError."""
    with open(descriptor, "rb", buffering=0, closefd=False) as stream:
        head, checksum = stream.read(_HEAD.size), stream.read(_CHECKSUM.size)
        size = _size(head, status.st_size)
        values = stream.read(size)
    if len(values) != size or checksum != _CHECKSUM.pack(_crc(head, values)):
        raise _UnusableError("it is damaged")
    identity, read, parts = marshal.loads(values)  # noqa: S302 - this user's Python wrote it
    return Stored(identity, status.st_mtime, read, Image(**parts))


def _check_owner(status: os.stat_result, what: str) -> None:
    if status.st_uid != os.geteuid():
        raise _UnusableError(f"{what} belongs to another user")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise _UnusableError(f"others may write to {what}")


def _size(head: bytes, size: int) -> int:
    """Return the size of the values in a file of this size. Raises _UnusableError."""
    if not head.startswith(_MAGIC[: len(head)]):
        raise _UnusableError("it is not a kept program")
    if len(head) < _HEAD.size:
        raise _UnusableError("it is truncated")
    _, form, version, values = _HEAD.unpack(head)
    if form != _FORMAT:
        raise _UnusableError("it has another format")
    if version != sys.hexversion:
        raise _UnusableError("it was written by another version of Python")
    if size != (whole := _HEAD.size + _CHECKSUM.size + values):
        raise _UnusableError("it is truncated" if size < whole else "it is damaged")
    return int(values)


def _remove_unfinished(place: str) -> None:
    """Remove the unfinished files of processes that ended while writing."""
    now = time.time()
    for written, path in _files(place, _UNFINISHED):
        if abs(now - written) > _STALE:
            with suppress(OSError):
                os.unlink(path)


def _remove_oldest(place: str, newest: str) -> None:
    others = sorted((each for each in _files(place, _ENDING) if each[1] != newest), reverse=True)
    for _, path in others[_MOST - 1 :]:
        for each in (path, path + _TRIES):
            with suppress(OSError):
                os.unlink(each)


def _files(place: str, ending: str) -> list[tuple[float, str]]:
    """Return the time of writing and the path of each file."""
    found = []
    for entry in os.scandir(place):
        if entry.name.endswith(ending):
            with suppress(OSError):
                found.append((entry.stat(follow_symlinks=False).st_mtime, entry.path))
    return found
