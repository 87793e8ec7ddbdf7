"""A test machine: a real systemd as process 1, in namespaces, over a copy-on-write view of this computer.

Changes are lost when it ends. Needs root, overlayfs and systemd; without them, tests are skipped. On a computer that
tests/platforms/boot.sh has booted, the machine is that computer itself.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep

import pytest

SYSTEMD = Path("/usr/lib/systemd/systemd")
PATIENCE = 240.0
NAMESPACES = ("--root", "--wd", "--mount", "--pid", "--net", "--uts", "--ipc", "--cgroup")
OWN = (Path("/run"), Path("/tmp"), Path("/dev/shm"), Path("/var/lib/systemd"))  # noqa: S108 - not to write to

BOOT = r"""
set -e
base=$1
mount --make-rprivate /
mount -t tmpfs tmpfs "$base"
mkdir -p "$base"/upper "$base"/work "$base"/root
mount -t overlay overlay -o lowerdir=/,upperdir="$base"/upper,workdir="$base"/work "$base"/root
cd "$base"/root
mount -t proc proc proc
mount -t sysfs sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount --rbind /dev dev
for folder in "${@:2}"; do mount -t tmpfs -o mode=1777 tmpfs $folder; done
chmod 755 run var/lib/systemd
ip link set lo up
# Start nothing that this computer starts at boot.
rm -rf etc/systemd/system etc/systemd/journald.conf.d
: > etc/machine-id  # without the file, systemd would take this for the first boot and enable the removed units
mkdir -p etc/systemd/system etc/systemd/journald.conf.d
printf '[Journal]\nStorage=volatile\nReadKMsg=no\nAudit=no\n' > etc/systemd/journald.conf.d/test.conf
cd etc/systemd/system
ln -s /lib/systemd/system/basic.target default.target
for unit in systemd-udevd systemd-udev-trigger systemd-tmpfiles-setup systemd-tmpfiles-setup-dev systemd-sysctl \
  systemd-modules-load systemd-random-seed systemd-update-utmp systemd-remount-fs systemd-sysusers ldconfig \
  systemd-network-generator networking systemd-pstore systemd-binfmt; do ln -s /dev/null $unit.service; done
for unit in dev-hugepages dev-mqueue sys-kernel-debug sys-kernel-tracing sys-kernel-config sys-fs-fuse-connections tmp
do ln -s /dev/null $unit.mount; done
cd "$base"/root
mkdir -p old
pivot_root . old
umount -l /old
export container=test
exec /usr/lib/systemd/systemd --system --log-target=journal --show-status=0
"""


class Machine:
    """A running test machine. `run` runs a command in it, as root."""

    def __init__(self, enter: Sequence[str] = ()) -> None:
        self._enter = enter

    def run(self, *command: object, check: bool = True, **more: str) -> subprocess.CompletedProcess[str]:
        finished = subprocess.run(
            [*self._enter, *map(str, command)],
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE,
            cwd="/",
            env={"PATH": os.environ["PATH"], "LANG": "C.UTF-8", **more},
        )
        assert not check or finished.returncode == 0, f"{command}\n{finished.stdout}\n{finished.stderr}"
        return finished

    def shell(self, script: str, check: bool = True) -> str:
        finished = self.run("sh", "-c", script, check=check)
        return finished.stdout + finished.stderr

    def journal(self, unit: str = "rover-router") -> str:
        return self.run("journalctl", "--unit", unit, "--no-pager", "--output", "cat").stdout

    def state(self, unit: str = "rover-router") -> str:
        return self.run("systemctl", "is-active", unit, check=False).stdout.strip()

    def show(self, name: str, unit: str = "rover-router") -> str:
        return self.run("systemctl", "show", "--property", name, "--value", unit).stdout.strip()

    def environment(self, unit: str = "rover-router") -> set[str]:
        """The environment of the unit's main process, as NAME=VALUE."""
        return set(self.run("cat", f"/proc/{self.show('MainPID', unit)}/environ").stdout.split("\0"))

    def wait_for(self, script: str) -> None:
        deadline = monotonic() + PATIENCE
        while self.run("sh", "-c", script, check=False).returncode:
            assert monotonic() < deadline, f"{script}\n{self.journal()}"
            sleep(0.05)


def hidden_by(folder: Path) -> Path | None:
    """The machine's own folder that hides this one, if any."""
    return next((own for own in OWN if folder.is_relative_to(own)), None)


def why_not() -> str | None:
    """Why this computer cannot run such a machine; None if it can."""
    if os.geteuid() != 0:
        return "needs root"
    for tool in ("unshare", "nsenter", "pivot_root", "ip", "systemctl"):
        if shutil.which(tool) is None:
            return f"needs {tool}"
    if not SYSTEMD.exists():
        return "needs systemd"
    if "overlay" not in Path("/proc/filesystems").read_text():
        return "needs overlayfs"
    return None if _cgroups() else "needs cgroup2"


def _cgroups() -> Path | None:
    mounts = (line.split() for line in Path("/proc/self/mounts").read_text().splitlines())
    return next((Path(folder) for _, folder, kind, *_ in mounts if kind == "cgroup2"), None)


@contextmanager
def machine(base: Path) -> Iterator[Machine]:
    """A booted machine; `base` is an empty folder."""
    if "BOOTED" in os.environ:
        yield Machine()
        return
    if reason := why_not():
        pytest.skip(f"no machine within this one: {reason}")
    cgroups = _cgroups()
    assert cgroups is not None
    own = cgroups / f"router-test-{os.getpid()}"
    own.mkdir()
    script = f'echo $$ > {own}/cgroup.procs; exec unshare -mpnuiC --fork --kill-child bash -c "$1" boot "${{@:2}}"'
    booting = subprocess.Popen(
        ["/bin/bash", "-c", script, "enter", BOOT, str(base), *(str(own)[1:] for own in OWN)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield _booted(booting)
    finally:
        booting.kill()  # --kill-child ends everything in the namespaces with it
        booting.communicate()
        _remove(own)


def _booted(booting: subprocess.Popen[str]) -> Machine:
    deadline = monotonic() + PATIENCE
    children = Path(f"/proc/{booting.pid}/task/{booting.pid}/children")
    while monotonic() < deadline:
        if booting.poll() is not None:
            pytest.skip(f"no machine within this one: {booting.communicate()[0]}")
        child = children.read_text().split()
        if child and Path(f"/proc/{child[0]}/comm").read_text().strip() == "systemd":
            found = Machine(["nsenter", "-t", child[0], *NAMESPACES, "--"])
            if found.run("systemctl", "is-system-running", check=False).stdout.strip() in ("running", "degraded"):
                return found
        sleep(0.05)
    raise AssertionError("the machine did not come up")


def _remove(cgroup: Path) -> None:
    """Remove a cgroup, its children first. The kernel takes a moment to notice that the last process has exited."""
    deadline = monotonic() + PATIENCE
    for folder in sorted(cgroup.rglob("*/"), key=lambda each: -len(each.parts)):
        if folder.is_dir():
            _remove_one(folder, deadline)
    _remove_one(cgroup, deadline)


def _remove_one(folder: Path, deadline: float) -> None:
    while True:
        try:
            folder.rmdir()
        except OSError:
            if monotonic() > deadline:
                raise
            sleep(0.05)
        else:
            return
