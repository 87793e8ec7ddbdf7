"""The process under test with its children, seen from outside: start, CPU, memory, losses. Knows not what it is."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from benchmarks.versus.contenders import Contender, Ports
from benchmarks.versus.processes import cores, cpu_of_others, family, processes, read, spawn

START_SECONDS = 30
STOP_SECONDS = 5
POLICY = 38
"""Where /proc/PID/stat has the scheduling policy, counted after the name of the program."""


def _sockets_on(port: int) -> list[list[str]]:
    rows = (line.split() for line in read("/proc/net/udp").splitlines()[1:])
    return [row for row in rows if int(row[1].rpartition(":")[2], 16) == port]


class Subject(AbstractContextManager["Subject"]):
    """Has its core to itself. Ends with its context; what it writes to stderr goes to `log`."""

    def __init__(self, contender: Contender, ports: Ports, log: Path) -> None:
        self._port = ports.listen[0]
        self._log = log
        self.contender = contender
        self.ports = ports
        with log.open("w") as stderr:
            words, environment = contender.words(ports), contender.environment(ports)
            self._process = spawn(words, cores().subject, environment=environment, stderr=stderr)

    def __exit__(self, *_: object) -> None:
        self.end(signal.SIGTERM, signal.SIGKILL)

    def end(self, *numbers: signal.Signals) -> None:
        """The whole family, by these signals; a wrapper would leave its children behind."""
        alive, deadline = self.pids(), time.monotonic() + STOP_SECONDS
        for number in numbers:
            for pid in alive:
                with suppress(ProcessLookupError):
                    os.kill(pid, number)
            while alive and time.monotonic() < deadline:
                time.sleep(0.02)
                self._process.poll()
                alive = {pid for pid in alive if Path(f"/proc/{pid}").exists()}

    def wait_until_bound(self) -> None:
        deadline = time.monotonic() + START_SECONDS
        while not _sockets_on(self._port):
            self.check(deadline)
            time.sleep(0.002)

    def check(self, deadline: float) -> None:
        """Ends this program if the process has ended, or if it is too late."""
        if self._process.poll() is not None or time.monotonic() > deadline:
            sys.exit(f"{self.contender.name} did not start:\n{self._log.read_text()}")

    def destinations(self) -> tuple[int, ...]:
        """The ports to which it sends each datagram."""
        return (self.ports.first, self.ports.second)[: self.contender.copies]

    def conditions(self) -> dict[str, float]:
        """What must be equal for a fair comparison, read from the running process.

        `copies` of each datagram that leave, which sinks verify; `receive_buffer` of the first listener in bytes, as
        the kernel counts it; `realtime`, 1 if any thread has a real-time priority.
        """
        words = ["ss", "--udp", "--all", "--memory", "--numeric", "--no-header", f"sport = :{self._port}"]
        listed = subprocess.run(words, capture_output=True, text=True, check=True)
        buffers = re.findall(r"\brb(\d+)", listed.stdout)
        threads = (read(path) for pid in self.pids() for path in Path(f"/proc/{pid}/task").glob("*/stat"))
        policies = [fields[POLICY] for thread in threads if (fields := thread.rpartition(")")[2].split())]
        realtime = str(os.SCHED_FIFO) in policies
        return {"copies": self.contender.copies, "receive_buffer": int(buffers[0]), "realtime": int(realtime)}

    def cpu_ns(self) -> int:
        """CPU time of all living threads."""
        return self.cpu_by_thread().total()

    def cpu_by_thread(self) -> Counter[str]:
        """CPU time (ns) of the living threads, by name: schedstat counts ns where utime and stime count ticks."""
        used: Counter[str] = Counter()
        for task in (task for pid in self.pids() for task in Path(f"/proc/{pid}/task").glob("*")):
            used[read(task / "comm").strip()] += int((read(task / "schedstat") or "0").split()[0])
        return used

    def kernel_drops(self) -> int:
        """Datagrams for which its first listener had no room, since it was opened."""
        return sum(int(row[-1]) for row in _sockets_on(self._port))

    def rss_mb(self) -> float:
        lines = (line for pid in self.pids() for line in read(f"/proc/{pid}/smaps_rollup").splitlines())
        return sum(int(line.split()[1]) for line in lines if line.startswith("Rss:")) * 1024 / 1e6

    def pids(self) -> set[int]:
        """The process that was started, and its descendants."""
        return family(self._process.pid, processes())

    def sockets(self) -> set[str]:
        """The sockets that listen on its first port, as links in /proc/PID/fd name them."""
        return {f"socket:[{row[9]}]" for row in _sockets_on(self._port)}


class Meter:
    """What the subject used since this was made, and what others used that should not have run."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._others = cpu_of_others()
        self._drops = subject.kernel_drops()
        self._cpu = subject.cpu_ns()
        self._began = time.monotonic()
        self.cpu_ns = self.drops = 0
        self.noise = 0.0

    def read(self) -> None:
        """Fills in the figures; `noise` is in cores."""
        elapsed = time.monotonic() - self._began
        self.cpu_ns = self._subject.cpu_ns() - self._cpu
        self.drops = self._subject.kernel_drops() - self._drops
        others = cpu_of_others()
        self.noise = sum(max(0.0, used - self._others.get(pid, 0.0)) for pid, used in others.items()) / elapsed
