"""The runs of this user on this machine: a file each, locked by its supervisor for as long as that lives."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from pathlib import Path

import msgspec

from runner.contract import Refused
from runner.recording.container import hold, is_being_written
from runner.transport.session import remove_sockets, runtime_folder


class Entry(msgspec.Struct, frozen=True):
    """What the live tools must know to reach a run."""

    run: str
    gateway: str
    """Where tools meet it: a socket of this user."""
    pid: int
    """Of the supervisor."""
    graph: str
    """Path of the graph file."""
    recording: str
    """Path of the file that is being written."""
    started: float
    """Seconds since the epoch."""


class Registration:
    """Lists a run until it is closed, or its process dies."""

    def __init__(self, entry: Entry) -> None:
        """Raises Refused where the folder cannot be made or is not this user's alone."""
        self._path = runtime_folder() / f"{entry.run}.json"
        unlisted = self._path.with_suffix(f".{os.getpid()}")
        self._file = unlisted.open("wb")
        hold(self._file)
        self._file.write(msgspec.json.format(msgspec.json.encode(entry)))
        self._file.flush()
        try:
            self._path.hardlink_to(unlisted)
        except FileExistsError:
            self._file.close()
            raise Refused(f"{entry.run}: another run of that name lives") from None
        finally:
            unlisted.unlink()

    def close(self) -> None:
        """Strikes the run off the list."""
        self._path.unlink(missing_ok=True)
        self._file.close()


@contextlib.contextmanager
def naming() -> Generator[None]:
    """Held by who chooses the name of a run and lists it: two that start together get different ones."""
    with (runtime_folder() / "naming").open("wb") as file:
        hold(file)
        yield


def runs() -> list[Entry]:
    """Every run that lives, oldest first; what dead ones have left is cleaned up."""
    found = filter(None, map(_read, runtime_folder().glob("*.json")))
    return sorted(found, key=lambda entry: (entry.started, entry.run))


def find_run(name: str | None = None) -> Entry:
    """The run of that name (or the only one whose name begins so), or the only run there is."""
    living = runs()
    exact = [entry for entry in living if entry.run == name]
    fitting = exact or [entry for entry in living if name is None or entry.run.startswith(name)]
    if len(fitting) == 1:
        return fitting[0]
    if not living:
        raise Refused("no graph is running on this machine; start one: runner up GRAPH")
    listed = ", ".join(entry.run for entry in fitting or living)
    if not fitting:
        raise Refused(f"--run {name}: no such run; valid: {listed}")
    raise Refused(f"{len(fitting)} graphs are running: choose one with --run; valid: {listed}")


def is_alive(entry: Entry) -> bool:
    """Whether a run is still listed by a supervisor that lives."""
    return any(other.run == entry.run for other in runs())


def _read(path: Path) -> Entry | None:
    """One entry, or None where its supervisor has died; its file is removed then."""
    try:
        with path.open("rb") as file:
            entry, lives = msgspec.json.decode(file.read(), type=Entry), is_being_written(file)
        if lives:
            return entry
        path.unlink(missing_ok=True)
        remove_sockets(entry.gateway)
    except OSError:
        pass  # it has just gone
    except msgspec.MsgspecError:
        path.unlink(missing_ok=True)
    return None
