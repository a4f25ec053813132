"""Starts graphs as a user does, and looks at what they leave."""

import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from runner import testing
from runner.testing import start_graph
from runner.transport.bus import Bus
from runner.transport.presence import Presence

TOYS, DOUBLES, ALBUM, ACCOUNT = (
    Path(__file__).with_name(f"{name}.yaml") for name in ("toys", "doubles", "album", "account")
)


@dataclass(frozen=True)
class Run(testing.Run):
    """A finished ``runner up`` of a graph whose sink writes a file."""

    @property
    def result(self) -> list[str]:
        return (self.folder / "out.txt").read_text().splitlines()


def start(graph: Path, folder: Path, *settings: str, flags: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    return start_graph(graph, f"sink.path={folder / 'out.txt'}", *settings, folder=folder, options=flags)


def finish(process: subprocess.Popen[str], folder: Path, before: str = "") -> Run:
    return Run(**vars(testing.finish(process, folder, before=before)))


def run(graph: Path, folder: Path, *settings: str, flags: tuple[str, ...] = ()) -> Run:
    return finish(start(graph, folder, *settings, flags=flags), folder)


def changed(source: Path, folder: Path, **changes: str) -> Path:
    """A graph file with the classes of some stages replaced: ``Worker="Troubled"``."""
    text = source.read_text()
    for old, new in changes.items():
        assert f"toys:{old}" in text
        text = text.replace(f"tests.runner.common.toys:{old}", f"tests.runner.common.survivors:{new}")
    path = folder / source.name
    path.write_text(text)
    return path


def pid_of(folder: Path, name: str) -> int:
    """The process that writes to a log of this run, for example ``doubler-0``."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            target = (entry / "fd/1").readlink()
        except OSError:
            continue
        if folder in target.parents and target.name == f"{name}.txt":
            return int(entry.name)
    raise AssertionError(f"no process writes {name}.txt")


def meeting_of(gateway: str) -> str:
    """Where the processes of a run meet that has this gateway."""
    own = Path(gateway.partition("/")[2])
    others = (path for path in own.parent.iterdir() if path != own and path.suffix != ".lock")
    return f"unixsock-stream/{min(others, key=lambda path: path.stat().st_ctime_ns)}"


def wait_for_links(bus: Bus, *processes: tuple[str, int]) -> None:
    """Waits until these, (stage, replica), hear what a bus publishes: a process announces itself once it listens."""
    presence, deadline = Presence(), time.monotonic() + 60
    bus.watch(presence.update)
    assert presence.wait_for(processes, lambda: time.monotonic() > deadline)


def processes_of(folder: Path) -> list[str]:
    """Command lines of processes whose output goes to this run's folder."""
    found: list[str] = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if str(folder) in str((entry / "fd/1").readlink()):
                found.append((entry / "cmdline").read_text())
        except OSError:
            continue
    return found
