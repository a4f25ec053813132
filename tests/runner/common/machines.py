"""Machines for tests of graphs on several hosts: all on loopback, or each in a network namespace of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from runner.transport.session import new_endpoint
from tests.runner.common.runs import Run, finish, run

HOSTS = Path(__file__).with_name("hosts.yaml")
NAMES = ("head", "worker1", "worker2")


@dataclass
class Machines:
    """Where the hosts of the toy graph run, and with which addresses."""

    addresses: dict[str, str]
    """Of the hosts whose addresses are not those of the graph file."""
    spaces: dict[str, str] = field(default_factory=dict)
    """Network namespace by host; empty on loopback."""

    def settings(self) -> list[str]:
        return [part for name, address in self.addresses.items() for part in ("--set", f"hosts.{name}={address}")]

    def start(self, host: str, folder: Path, *options: str, graph: Path = HOSTS) -> subprocess.Popen[str]:
        """``runner up`` of one host; what it records and logs is in ``folder/HOST``."""
        inside = _inside(self.spaces[host], folder) if self.spaces else []
        command = [*inside, sys.executable, "-m", "runner.cli", "up", str(graph), "--host", host]
        command += ["--recordings", str(folder / host), *self.settings(), *options]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def cut(self, host: str) -> None:
        """Pulls the cable of a worker."""
        _ip("-n", self.spaces["head"], "link", "set", f"to-{host}", "down")

    def mend(self, host: str) -> None:
        """Plugs it in again."""
        _ip("-n", self.spaces["head"], "link", "set", f"to-{host}", "up")


def free_address() -> str:
    """ADDRESS:PORT on loopback where nobody listens."""
    return new_endpoint("tls/127.0.0.1:0").partition("/")[2]


def on_loopback() -> Machines:
    return Machines({"head": free_address()})


@contextlib.contextmanager
def in_namespaces() -> Iterator[Machines]:
    """Three namespaces on one bridge, which is in the head's; skips the test where this process may not make them."""
    spaces = {name: f"runner-{os.getpid()}-{name}" for name in NAMES}
    try:
        for space in spaces.values():
            _ip("netns", "add", space)
        _connect(spaces)
        yield Machines({name: _address(name) + (":7447" if name == "head" else "") for name in NAMES}, spaces)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = error.stderr.strip() if isinstance(error, subprocess.CalledProcessError) else str(error)
        pytest.skip(f"network namespaces cannot be made here: {reason}")
    finally:
        for space in spaces.values():
            with contextlib.suppress(OSError):
                subprocess.run(["ip", "netns", "del", space], check=False, capture_output=True)


def _inside(space: str, folder: Path) -> list[str]:
    """Runs a command as on another machine: with a network, shared memory and a clock of its own."""
    clock = folder / f"boot-{space}"
    clock.write_text(space)
    mounts = f"mount -t tmpfs none /dev/shm && mount --bind {clock} /proc/sys/kernel/random/boot_id"
    return ["ip", "netns", "exec", space, "sh", "-c", f'{mounts} && exec "$@"', "sh"]


def _connect(spaces: dict[str, str]) -> None:
    head = spaces["head"]
    _ip("-n", head, "link", "add", "bridge", "type", "bridge")
    _ip("-n", head, "address", "add", f"{_address('head')}/24", "dev", "bridge")
    for name in NAMES[1:]:
        _ip("-n", head, "link", "add", f"to-{name}", "type", "veth", "peer", "name", "cable", "netns", spaces[name])
        _ip("-n", head, "link", "set", f"to-{name}", "master", "bridge", "up")
        _ip("-n", spaces[name], "address", "add", f"{_address(name)}/24", "dev", "cable")
        _ip("-n", spaces[name], "link", "set", "cable", "up")
    _ip("-n", head, "link", "set", "bridge", "up")
    for space in spaces.values():
        _ip("-n", space, "link", "set", "lo", "up")


def _address(name: str) -> str:
    return f"10.77.0.{1 + NAMES.index(name)}"


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@dataclass
class Party:
    """All hosts of one run, while it runs and after."""

    machines: Machines
    folder: Path
    options: tuple[str, ...] = ()
    graph: Path = HOSTS
    hosts: dict[str, subprocess.Popen[str]] = field(default_factory=dict)

    def start(self, host: str, *settings: str) -> subprocess.Popen[str]:
        own = [f"sink.path={self.folder / 'out.txt'}", *settings] if host == "head" else []
        changes = [part for setting in own for part in ("--set", setting)]
        self.hosts[host] = self.machines.start(host, self.folder, *self.options, *changes, graph=self.graph)
        return self.hosts[host]

    def start_all(self, *settings: str) -> Party:
        for host in NAMES:
            self.start(host, *settings)
        return self

    def end(self, host: str, before: str = "") -> Run:
        """Waits until a host has ended."""
        return finish(self.hosts.pop(host), self.folder / host, before)

    def close(self) -> None:
        for process in self.hosts.values():
            process.kill()
            process.communicate()


def run_here(folder: Path) -> Run:
    """The same graph, undisturbed, on one machine."""
    return run(HOSTS, folder, flags=("--here",))
