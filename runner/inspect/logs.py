"""What a run has said: the log lines of its recording, also while it is being written, and what processes printed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from mcap.records import Metadata

from runner.contract import Refused
from runner.graph.document import suggest
from runner.graph.graph import SUPERVISOR
from runner.message.codec import CodecError, LogLine, unpack
from runner.message.packet import RECORDER
from runner.recording.container import Container, Growing, open_file, recordings_in
from runner.recording.recording import LOG, RUN, decoded


def log_lines(path: Path, stage: str | None, *, follow: bool) -> Iterator[LogLine]:
    """Every line, or those of one stage, in the order of recording; with ``follow`` goes on until the graph has ended.

    Raises Refused where the graph has no such stage.
    """
    with open_file(path) as file:
        source: IO[bytes] | Growing = Growing(file) if follow else file
        for record in Container(source, str(path)):
            if isinstance(record, Metadata):
                if record.name == RUN and stage is not None:
                    _require(stage, decoded(record.metadata.get("graph", ""), dict[str, Any]), path)
            elif record.topic.startswith(LOG) and stage in (None, record.topic.removeprefix(LOG)):
                with contextlib.suppress(CodecError):
                    yield unpack(LogLine, record.message.data)


def _require(stage: str, graph: Mapping[str, Any], path: Path) -> None:
    speakers = (*graph.get("stages", ()), SUPERVISOR, RECORDER)
    if stage not in speakers:
        raise Refused(f"{path}: no stage {stage!r}{suggest(stage, speakers)}")


def printed_lines(recording: Path, stage: str) -> Iterator[tuple[str, str]]:
    """(process, line) of what the processes of a stage wrote to their output: tracebacks, warnings."""
    for path in sorted((recording.with_suffix("") / "log").glob("*.txt")):
        if path.stem.rpartition("-")[0] == stage:
            for line in path.read_text(errors="replace").splitlines():
                yield path.stem, line


def newest_recording(folder: Path) -> Path:
    """The recording that was written last; raises Refused where there is none."""
    found = recordings_in(folder)
    if not found:
        raise Refused(f"{folder}: no recordings; start a graph: runner up GRAPH, or name a folder: --recordings DIR")
    return found[0]
