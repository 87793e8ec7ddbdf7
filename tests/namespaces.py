"""Network namespaces for tests: computers in isolated networks."""

from __future__ import annotations

import ctypes
import itertools
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import TypeVar

import pytest

T = TypeVar("T")

CLONE_NEWNET = 0x40000000
_numbers = itertools.count()
_libc = ctypes.CDLL(None, use_errno=True)


class Computer:
    """A network namespace. Sockets opened by `inside` stay in it, whichever thread uses them later."""

    def __init__(self, name: str) -> None:
        self.namespace = f"router{os.getpid()}-{next(_numbers)}-{name}"

    def run(self, *command: object, check: bool = True) -> str:
        """Run a command in the namespace and return its output."""
        return _run("ip", "netns", "exec", self.namespace, *command, check=check)

    def ip(self, *arguments: object) -> str:
        return _run("ip", "-n", self.namespace, *arguments)

    def nft(self, *arguments: object) -> str:
        """Change the firewall; skip the test if there is no `nft`."""
        if shutil.which("nft") is None:
            pytest.skip("needs nft (nftables)")
        return self.run("nft", *arguments)

    def inside(self, call: Callable[[], T]) -> T:
        """Return the result of `call` in a thread that has entered the namespace."""

        def enter_and_call() -> T:
            with Path("/run/netns", self.namespace).open() as namespace:
                if _libc.setns(namespace.fileno(), CLONE_NEWNET):
                    raise OSError(ctypes.get_errno(), "setns")
            return call()

        with ThreadPoolExecutor(1) as thread:
            return thread.submit(enter_and_call).result()


@contextmanager
def computers(*names: str) -> Iterator[list[Computer]]:
    """New namespaces in which only the loopback interface is up; skip the test if they cannot be created.

    They accept every source address (rp_filter 0), the kernel's default and the worst case for an attack. An IPv6
    address can be used at once.
    """
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("needs root and `ip`, for network namespaces")
    with ExitStack() as ending:
        found = [Computer(name) for name in names]
        for computer in found:
            _run("ip", "netns", "add", computer.namespace)
            ending.callback(_run, "ip", "netns", "del", computer.namespace)
            computer.ip("link", "set", "lo", "up")
            for which in ("all", "default"):
                computer.run("sysctl", "-qw", f"net.ipv4.conf.{which}.rp_filter=0")
                computer.run("sysctl", "-qw", f"net.ipv6.conf.{which}.accept_dad=0")
        yield found


def cable(one: Computer, end: str, address: str, other: Computer, other_end: str, other_address: str) -> None:
    """Connect two computers by a veth pair, with an interface name and an address (`10.78.1.1/24`) at each end.

    With IPv6 addresses, wait until the kernel lets both ends send to groups and receive from them.
    """
    one.ip("link", "add", end, "type", "veth", "peer", "name", other_end, "netns", other.namespace)
    for computer, name, network in ((one, end, address), (other, other_end, other_address)):
        computer.ip("address", "add", network, "dev", name)
        computer.ip("link", "set", name, "up")
    for computer, name, network in ((one, end, address), (other, other_end, other_address)):
        deadline = monotonic() + 10
        while ":" in network and not computer.ip("-6", "route", "show", "table", "local", "dev", name, "ff00::/8"):
            assert monotonic() < deadline, f"{name} does not come up"
            sleep(0.02)


@contextmanager
def narrow_path() -> Iterator[tuple[Computer, Computer]]:
    """The computers 10.78.1.1 and 10.78.2.2; a router between them has a smaller MTU (1280) on the second's side.

    The router's ICMP messages are filtered, so the first computer does not learn of that MTU.
    """
    with computers("near", "between", "far") as (near, between, far):
        cable(near, "eth0", "10.78.1.1/24", between, "wide", "10.78.1.2/24")
        cable(between, "narrow", "10.78.2.1/24", far, "eth0", "10.78.2.2/24")
        for computer, interface in ((between, "narrow"), (far, "eth0")):
            computer.ip("link", "set", interface, "mtu", 1280)
        between.run("sysctl", "-qw", "net.ipv4.ip_forward=1")
        between.nft("add table ip filter; add chain ip filter output { type filter hook output priority 0; }")
        between.nft("add rule ip filter output icmp type destination-unreachable drop")
        near.ip("route", "add", "default", "via", "10.78.1.2")
        far.ip("route", "add", "default", "via", "10.78.2.1")
        yield near, far


def _run(*command: object, check: bool = True) -> str:
    finished = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, timeout=60)
    assert not check or finished.returncode == 0, f"{command}\n{finished.stdout}{finished.stderr}"
    return finished.stdout + finished.stderr
