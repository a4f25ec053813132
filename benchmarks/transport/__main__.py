"""From publisher to handler, beside bare Zenoh and dora-rs: `python -m benchmarks.transport [--rounds 3]`.

Two processes on one machine: one sends an array of each size, waits for the answer, pauses and sends the next; the
other reads the clock in its handler. Every contender sends the same arrays at the same pace, in turns, and starts from
an array in memory: what it takes to encode is counted. dora-rs takes part where the extra ``benchmarks`` is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.transport.schedule import SIZES

_HERE = Path(__file__).parent
Times = dict[str, list[float]]
"""Microseconds by size in bytes."""
Contender = Callable[[int, Path], Times]


def zenoh(messages: int, folder: Path) -> Times:
    """Bare Zenoh."""
    command = [sys.executable, "-m", "benchmarks.transport.bare_zenoh", str(messages)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def dora(messages: int, folder: Path) -> Times:
    """dora-rs, as ``dora run`` starts it."""
    out = folder / "dora.json"
    script = str(_HERE / "dora_node.py")

    def node(role: str, source: str, input: str, output: str) -> dict[str, Any]:
        environment = {"MESSAGES": str(messages), "OUT": str(out), "ROLE": role}
        return {"id": role, "path": script, "env": environment, "inputs": {input: source}, "outputs": [output]}

    nodes = [
        node("sender", "receiver/arrived", "arrived", "blob"),
        node("receiver", "sender/blob", "blob", "arrived"),
    ]
    graph = folder / "dataflow.yml"
    graph.write_text(json.dumps({"nodes": nodes}))
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    subprocess.run(
        ["dora", "run", str(graph)], check=True, cwd=folder, env={**os.environ, "PATH": path}, capture_output=True
    )
    return json.loads(out.read_text())


def runner(messages: int, folder: Path, *arguments: str) -> Times:
    """This project's runner."""
    out = folder / "runner.json"
    stages = {
        "sender": {
            "stage": "benchmarks.transport.stages:Sender",
            "config": {"out": str(out), "messages": messages},
            "inputs": {"arrived": "receiver.arrived"},
        },
        "receiver": {"stage": "benchmarks.transport.stages:Receiver", "inputs": {"blob": "sender.blob"}},
    }
    graph = folder / "graph.yaml"
    graph.write_text(json.dumps({"name": "transport", "stages": stages}))
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--recordings", str(folder), *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    for recording in folder.glob("*.mcap"):
        recording.unlink()
    return json.loads(out.read_text())


def unrecorded(messages: int, folder: Path) -> Times:
    """The runner with its journal, and no message recorded."""
    return runner(messages, folder, "--steps-only")


CONTENDERS: dict[str, Contender] = {
    "bare zenoh": zenoh,
    "runner": unrecorded,
    "runner, recording": runner,
    "dora-rs": dora,
}


def lines(found: dict[str, list[Times]]) -> list[str]:
    """The table: medians over rounds of each round's p50 and p99, and the ratio of the p50 to bare Zenoh's."""
    rows = [f"{'bytes':>9}  " + "  ".join(f"{name + ' p50/p99 us':>30}" for name in found)]
    for size in map(str, SIZES):
        p50, p99 = ({name: _quantile(times, size, q) for name, times in found.items()} for q in (50, 99))
        base = p50.get("bare zenoh", np.nan)
        cells = (f"{p50[name]:9.0f} /{p99[name]:9.0f} ({p50[name] / base:5.2f}x)" for name in found)
        rows.append(f"{size:>9}  " + "  ".join(f"{cell:>30}" for cell in cells))
    return rows


def _quantile(rounds: Sequence[Times], size: str, percent: float) -> float:
    return float(np.median([np.percentile(times[size], percent) for times in rounds]))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--messages", type=int, default=100, help="of each size and round")
    parser.add_argument("--only", nargs="*", choices=CONTENDERS, default=list(CONTENDERS))
    options = parser.parse_args()
    names = [name for name in options.only if name != "dora-rs" or importlib.util.find_spec("dora")]
    if "dora-rs" in options.only and "dora-rs" not in names:
        print("dora-rs is not installed: pip install -e '.[benchmarks]'")
    found: dict[str, list[Times]] = {name: [] for name in names}
    for _ in range(options.rounds):
        for name in names:
            with tempfile.TemporaryDirectory() as folder:
                found[name].append(CONTENDERS[name](options.messages, Path(folder)))
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
