"""A graph of a few stages that runs while a benchmark looks at its processes."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

from runner.contract import Refused
from runner.live.live import Live
from runner.supervise.registry import runs
from runner.supervise.status import ProcessStatus, RunStatus

POLL_SECONDS = 0.1


@contextlib.contextmanager
def running(folder: Path, name: str, stages: Mapping[str, Any], **keys: str) -> Generator[Live]:
    """Records a graph into an empty folder and asks it to end; raises Refused where it ends before it is ready.

    ``keys`` are what the graph says beside its name and stages.
    """
    graph = folder / "graph.yaml"
    graph.write_text(json.dumps({"name": name, "stages": stages, **keys}))
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--recordings", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as run:
        try:
            with Live(_entry(run, folder)) as live:
                live.wait_until_ready()
                yield live
        finally:
            run.terminate()


def _entry(run: subprocess.Popen[bytes], folder: Path) -> Any:
    while run.poll() is None:
        for entry in runs():
            if Path(entry.recording).is_relative_to(folder):
                return entry
        time.sleep(POLL_SECONDS)
    raise Refused(f"the graph in {folder} ended with exit code {run.returncode} before it was ready")


def process(status: RunStatus, stage: str) -> ProcessStatus:
    """One process of a run: a stage, or the recorder."""
    return next(found for found in status.processes if found.stage == stage)
