"""How much of an episode messages spend on their way: `python -m benchmarks.travel [FILE]`.

The critical path of a whole recording leads from its last message back to a start, at each step over the input that
came last. Printed: what its steps took to compute, what their inputs queued and travelled, and the share of the wall
time from the path's first message to its last that is travelling. Without a file the default graph runs for one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.common.command import command
from runner.contract import Refused
from runner.inspect.causes import Causes
from runner.message.codec import Step
from runner.recording.recording import Recording

_GRAPH = Path(__file__).parents[2] / "graph.yaml"
AIM = 0.015


def episode(folder: Path, settings: Sequence[str]) -> Path:
    """Runs the default graph; returns its recording."""
    run = [sys.executable, "-m", "runner.cli", "up", str(_GRAPH), "--recordings", str(folder)]
    run += [part for setting in settings for part in ("--set", setting)]
    subprocess.run(run, stdout=subprocess.DEVNULL, check=True)
    return next(folder.glob("*.mcap"))


def path_of(recording: Recording) -> list[str]:
    """Ids from a start to the last message, each the last input of the step that emitted the next."""
    if not recording.messages:
        raise Refused(f"{recording.path}: holds no message")
    causes = Causes(recording)
    path = [max(recording.messages.values(), key=lambda message: message.log_time_ns).id]
    while (cause := causes.last_input(path[-1])) is not None:
        path.append(cause)
    return path[::-1]


def share(recording: Recording) -> tuple[float, Iterator[str]]:
    """The share of the wall time that is travelling, and the lines of the table."""
    path, causes = path_of(recording), Causes(recording)
    steps = [step for id in path[1:] if (step := causes.step_of(id)) is not None]
    times = [recording.messages[id].log_time_ns for id in (path[0], path[-1])]
    wall = max(1, times[1] - times[0]) / 1e9
    rows = {name: _sum(steps, name) for name in ("computed_ns", "waited_ns", "travelled_ns")}
    return rows["travelled_ns"] / wall, _lines(path, steps, wall, rows)


def _sum(steps: Sequence[Step], name: str) -> float:
    return sum(getattr(step, name) for step in steps) / 1e9


def _lines(path: Sequence[str], steps: Sequence[Step], wall: float, rows: dict[str, float]) -> Iterator[str]:
    yield f"from {path[0]} to {path[-1]}: {len(steps)} steps in {wall:.2f} s"
    for name, seconds in rows.items():
        yield f"{name.removesuffix('_ns'):<12}{seconds:8.3f} s {seconds / wall:7.2%}"


@command
def main() -> int:
    """Prints the table; exits 1 where travelling takes more than its aim."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="a recording")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="as `runner up --set`")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file: Path = options.file or episode(Path(folder), options.settings)
        travelling, lines = share(Recording(file))
        print("\n".join(lines))
    print(
        f"travelling is {travelling:.2%} of the wall time: {'reached' if travelling <= AIM else 'MISSED'} ({AIM:.1%})"
    )
    return int(travelling > AIM)


if __name__ == "__main__":
    raise SystemExit(main())
