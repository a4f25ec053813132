"""The recordings beside that of a run: when each was made, how long it lasted, whether it is whole."""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec
from mcap.reader import make_reader
from mcap.records import Metadata

from runner.contract import Refused
from runner.recording.container import BROKEN, Container, is_being_written, recordings_in
from runner.recording.recording import RUN, VERDICT


class PastRun(msgspec.Struct, frozen=True):
    """What the beginning and the end of a recording say."""

    name: str
    """Of the file, without ``.mcap``."""
    graph: str
    started: float
    """Seconds since the epoch."""
    seconds: float
    bytes: int
    verdict: str
    """COMPLETE, INCOMPLETE, or empty where it is still being written or its end is missing."""
    running: bool


def past_runs(folder: Path) -> list[PastRun]:
    """Every recording in a folder that can be read, the newest first."""
    found = filter(None, map(_read, recordings_in(folder)))
    return sorted(found, key=lambda run: run.started, reverse=True)


def _begun(records: Container) -> tuple[str, float]:
    """The graph and the start of a recording that has no end yet; empty and 0 where it has no beginning either."""
    graph = ""
    with contextlib.suppress(Refused):
        for record in records:
            if not isinstance(record, Metadata):
                return graph, record.message.log_time * 1e-9
            graph = record.metadata.get("name", "") if record.name == RUN else graph
    return graph, 0.0


def _read(path: Path) -> PastRun | None:
    try:
        with path.open("rb") as file:
            size, modified = path.stat().st_size, path.stat().st_mtime
            if is_being_written(file):
                graph, started = _begun(Container(file, path.name))
                return PastRun(path.stem, graph, started or modified, 0.0, size, "", True)
            reader = make_reader(file)
            summary = reader.get_summary()
            said = {record.name: record.metadata for record in reader.iter_metadata()}
    except (*BROKEN, OSError):
        return None
    statistics = summary.statistics if summary else None
    start, end = (statistics.message_start_time, statistics.message_end_time) if statistics else (0, 0)
    verdict = said.get(VERDICT, {}).get("verdict", "")
    return PastRun(
        path.stem, said.get(RUN, {}).get("name", ""), start * 1e-9, (end - start) * 1e-9, size, verdict, False
    )
