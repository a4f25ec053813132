"""Looks for what would keep a graph from running on this machine, and says what to type."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import resource
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psutil

from runner.contract import Refused, Stage
from runner.graph.graph import Node
from runner.graph.reading import load_graph
from runner.graph.references import load_class
from runner.inspect.info import byte_count
from runner.live.tables import from_here
from runner.transport.bus import Bus
from runner.transport.session import new_endpoint, remove_sockets, runtime_folder

Judgement = Literal["good", "note", "bad"]
LEAST_DISK = 2 * 10**9
LEAST_MEMORY = 2 * 10**9
LEAST_FILES = 1024
LEAST_PROCESSES = 256
PROBE_SECONDS = 20


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    judgement: Judgement
    """``good``; ``note``, with which graphs still run; ``bad``, with which they do not."""
    subject: str
    text: str
    remedy: str = ""
    """What to type."""

    def lines(self) -> Iterator[str]:
        """As it is printed."""
        yield f"{self.judgement:<5} {self.subject:<14} {self.text}"
        if self.remedy:
            yield f"{'':<20} -> {self.remedy}"


def examine(recordings: Path) -> Iterator[Finding]:
    """Every finding, in the order of what a run needs first; a check that breaks is a finding too."""
    version, cores = platform.python_version(), os.cpu_count()
    checks: tuple[tuple[str, Callable[[], Finding]], ...] = (
        ("python", lambda: Finding("good", "python", f"{version}, {cores} cores")),
        ("packages", _packages),
        ("loopback", _loopback),
        ("zenoh", _zenoh),
        ("runs", lambda: Finding("good", "runs", f"are listed in {runtime_folder()}")),
        ("recordings", lambda: _recordings(recordings)),
        ("memory", _memory),
        ("limits", _limits),
    )
    for subject, check in checks:
        try:
            yield check()
        except Exception as error:  # one that was not foreseen is worth knowing and no reason to stop
            yield Finding("bad", subject, f"{type(error).__name__}: {error}")


def examine_graph(path: Path) -> Iterator[Finding]:
    """Whether a graph is well-formed, all that its stages import is here, and the machine has what they ask for."""
    try:
        graph = load_graph(path)
    except Refused as refusal:
        for line in str(refusal).splitlines():
            yield Finding("bad", "graph", line)
        return
    yield Finding("good", "graph", f"{path}: {len(graph.nodes)} stages can be imported")
    for node in graph.nodes.values():
        if node.type.cls.examine.__func__ is not Stage.examine.__func__:
            yield _ask(node)


def _ask(node: Node) -> Finding:
    """What a stage says of the machine, in a process of its own: a broken driver takes its process with it."""
    command = [sys.executable, "-c", "from runner.cli.doctor import answer; answer()", node.stage]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    try:
        said = subprocess.run(
            command, capture_output=True, text=True, timeout=PROBE_SECONDS, check=False, env=environment
        )
    except subprocess.TimeoutExpired:
        return Finding("bad", node.name, f"what it needs hangs: no answer in {PROBE_SECONDS} s")
    if said.returncode == 0:
        return Finding("good", node.name, said.stdout.strip())
    return Finding("bad", node.name, (said.stderr.splitlines() or [f"its process ended with {said.returncode}"])[-1])


def answer() -> None:
    """Prints what the stage class named on the command line says of the machine."""
    cls: type[Stage] = load_class(sys.argv[1], sys.argv[1])
    try:
        print(cls.examine())
    except Refused as refusal:
        sys.exit(str(refusal))


# ------------------------------------------------------------------------------------------ versions


def _packages() -> Finding:
    """What the project needs, by its own metadata; what it was tested with, where the list lies beside it."""
    (project, *_) = importlib.metadata.packages_distributions()["runner"]
    requirements = importlib.metadata.requires(project) or ()
    needed = [re.split(r"[\s;<>=!~\[(]", text)[0] for text in requirements if "extra ==" not in text]
    absent = [name for name in needed if _version(name) is None]
    tested = _tested()
    install = f"{sys.executable} -m pip install {'--constraint constraints.txt --editable .' if tested else project}"
    if absent:
        return Finding("bad", "packages", f"missing: {', '.join(absent)}", install)
    other = [
        f"{name} {_version(name)} instead of {tested[key]}"
        for name in needed
        if tested.get(key := _key(name)) not in (None, _version(name))
    ]
    if other:
        return Finding("note", "packages", f"not the tested versions: {', '.join(other)}", install)
    return Finding("good", "packages", f"{len(needed)} needed, {len(needed) if tested else 'none'} known as tested")


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name).partition("+")[0]
    except importlib.metadata.PackageNotFoundError:
        return None


def _tested() -> dict[str, str]:
    path = Path(__file__).parents[2] / "constraints.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    pairs = (line.split("==") for line in lines if "==" in line and not line.startswith("#"))
    return {_key(name): version.strip() for name, version in pairs}


def _key(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


# ------------------------------------------------------------------------------------------ transport


def _loopback() -> Finding:
    with socket.socket() as server, socket.socket() as client:
        server.bind(("127.0.0.1", 0))
        server.listen()
        client.settimeout(5)
        client.connect(server.getsockname())
        return Finding("good", "loopback", f"127.0.0.1:{server.getsockname()[1]} takes calls")


def _zenoh() -> Finding:
    """Two sessions as two processes of a graph would have them, and a question from one to the other."""
    version = importlib.metadata.version("eclipse-zenoh")
    endpoint = new_endpoint()
    try:
        server, client = Bus("doctor", endpoint, listen=True), Bus("doctor", endpoint)
        server.serve("echo", lambda question: question)
        answer = client.ask("echo", b"well", 10)
        client.close()
        server.close()
    except Refused as refusal:
        return Finding("bad", "zenoh", f"{version}: two sessions do not meet: {refusal}")
    finally:
        remove_sockets(endpoint)
    return Finding("good" if answer == b"well" else "bad", "zenoh", f"{version}: two sessions meet at a socket")


# ------------------------------------------------------------------------------------------ resources


def _recordings(folder: Path) -> Finding:
    beside = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not (beside.is_dir() and os.access(beside, os.W_OK)):
        return Finding(
            "bad", "recordings", f"{beside} is no folder that can be written", "runner up GRAPH --recordings DIR"
        )
    free = shutil.disk_usage(beside).free
    remedy = "" if free >= LEAST_DISK else "remove old recordings, or runner up GRAPH --recordings DIR"
    return Finding(
        "bad" if remedy else "good", "recordings", f"{byte_count(free)} free in {from_here(str(beside))}", remedy
    )


def _memory() -> Finding:
    available = psutil.virtual_memory().available
    limit, used = _group("memory.max"), _group("memory.current")
    if limit is not None and used is not None:
        available = min(available, limit - used + _idle_files())
    group = f", the control group allows {byte_count(limit)}" if limit is not None else ""
    remedy = "" if available >= LEAST_MEMORY else "end other programs, or give the container more memory"
    return Finding("bad" if remedy else "good", "memory", f"{byte_count(available)} available{group}", remedy)


def _idle_files() -> int:
    """Bytes that the control group uses for files nobody has read of late: the system gives them back when asked."""
    used = dict(line.split() for line in _group_text("memory.stat").splitlines())
    return int(used.get("inactive_file", 0))


def _group(name: str) -> int | None:
    """A limit of this process' control group, or None where there is none."""
    text = _group_text(name)
    return int(text) if text.isdecimal() else None


def _group_text(name: str) -> str:
    """What a file of this process' control group (version 2) says; nothing where it is not there."""
    try:
        own = Path("/proc/self/cgroup").read_text().splitlines()[-1].split("::")[1].lstrip("/")
        return (Path("/sys/fs/cgroup") / own / name).read_text().strip()
    except (OSError, IndexError):
        return ""


def _limits() -> Finding:
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    processes, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    threads = [limit for limit in (processes, _group("pids.max")) if limit not in (None, resource.RLIM_INFINITY)]
    least = min(threads, default=None)
    if files < LEAST_FILES:
        return Finding("bad", "limits", f"{files} open files, {LEAST_FILES} are needed", f"ulimit -n {LEAST_FILES}")
    if least is not None and least < LEAST_PROCESSES:
        text = f"{least} processes and threads, {LEAST_PROCESSES} are needed"
        return Finding("bad", "limits", text, f"ulimit -u {LEAST_PROCESSES}")
    return Finding("good", "limits", f"{files} open files, {least or 'any number of'} processes and threads")
