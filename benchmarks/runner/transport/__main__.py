"""From publisher to handler, beside bare Zenoh and dora-rs: `python -m benchmarks.transport [--rounds 3]`.

Processes of one machine: one sends an array of each size, waits for the answer, pauses and sends the next; another
reads the clock in its handler. Every contender sends the same arrays at the same pace, in turns, with the same settings
of the allocator, and starts from an array in memory: what it takes to encode is counted. The runner's recorder hears
everything, with and without `--steps-only`, so bare Zenoh and dora-rs have a second process too that takes what comes;
with one consumer alone they are shown as well. Bare Zenoh has loopback TCP and, like the runner, no shared memory; it
is also shown over Unix sockets, which the runner uses, and with shared memory, which is on by default.
dora-rs takes part where the extra ``benchmarks`` is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner.transport.schedule import SIZES
from runner.process.children import ENVIRONMENT

_HERE = Path(__file__).parent
Times = dict[str, list[float]]
"""Microseconds by size in bytes."""
Contender = Callable[[int, Path], Times]


BASE = "bare Zenoh"
PEER = "dora-rs"
AIM = 1.5
"""What the runner may take while it records, by the median of bare Zenoh."""


def zenoh(messages: int, folder: Path, **settings: Any) -> Times:
    """Bare Zenoh, see :class:`benchmarks.transport.bare_zenoh.Settings`."""
    task = json.dumps({"messages": messages, **settings})
    command = [sys.executable, "-m", "benchmarks.runner.transport.bare_zenoh", "send", task]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=_environment())
    return json.loads(done.stdout)


def dora(messages: int, folder: Path, *, listeners: int = 1) -> Times:
    """dora-rs, as ``dora run`` starts it."""
    out = folder / "dora.json"
    script = str(_HERE / "dora_node.py")

    def node(name: str, role: str, inputs: Mapping[str, str], outputs: Sequence[str]) -> dict[str, Any]:
        environment = {"MESSAGES": str(messages), "OUT": str(out), "ROLE": role}
        return {"id": name, "path": script, "env": environment, "inputs": dict(inputs), "outputs": list(outputs)}

    nodes = [
        node("sender", "sender", {"arrived": "receiver/arrived"}, ["blob"]),
        node("receiver", "receiver", {"blob": "sender/blob"}, ["arrived"]),
        *(node(f"listener-{number}", "listener", {"blob": "sender/blob"}, ()) for number in range(listeners)),
    ]
    graph = folder / "dataflow.yml"
    graph.write_text(json.dumps({"nodes": nodes}))
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**_environment(), "PATH": path}
    subprocess.run(["dora", "run", str(graph)], check=True, cwd=folder, env=environment, capture_output=True)
    return json.loads(out.read_text())


def _environment() -> dict[str, str]:
    return {**os.environ, **ENVIRONMENT}


def runner(messages: int, folder: Path, *arguments: str) -> Times:
    """This project's runner."""
    out = folder / "runner.json"
    stages = {
        "sender": {
            "stage": "benchmarks.runner.transport.stages:Sender",
            "config": {"out": str(out), "messages": messages},
            "inputs": {"arrived": "receiver.arrived"},
        },
        "receiver": {"stage": "benchmarks.runner.transport.stages:Receiver", "inputs": {"blob": "sender.blob"}},
    }
    graph = folder / "graph.yaml"
    graph.write_text(json.dumps({"name": "transport", "stages": stages}))
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--recordings", str(folder), *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    for recording in folder.glob("*.mcap"):
        recording.unlink()
    return json.loads(out.read_text())


CONTENDERS: dict[str, Contender] = {
    BASE: zenoh,
    "bare Zenoh, Unix sockets": partial(zenoh, protocol="unixsock-stream"),
    "bare Zenoh, shared memory": partial(zenoh, shared_memory=True),
    "bare Zenoh, one consumer": partial(zenoh, listeners=0),
    "runner": runner,
    "runner, --steps-only": lambda messages, folder: runner(messages, folder, "--steps-only"),
    PEER: dora,
    "dora-rs, one consumer": partial(dora, listeners=0),
}


def lines(found: Mapping[str, Sequence[Times]]) -> Iterator[str]:
    """The table: medians over rounds of each round's p50 and p99, and the ratio of the p50 to bare Zenoh's."""
    yield "p50 / p99 in microseconds (p50 by that of bare Zenoh)"
    yield f"{'bytes':>25}" + "".join(f"{size:>26}" for size in SIZES)
    base = _quantiles(found.get(BASE, ()), 50)
    for name, rounds in found.items():
        rows = zip(_quantiles(rounds, 50), _quantiles(rounds, 99), base, strict=True)
        cells = (f"{p50:9.0f} /{p99:7.0f} ({p50 / zenoh:4.2f})" for p50, p99, zenoh in rows)
        yield f"{name:>25}" + "".join(f"{cell:>26}" for cell in cells)


def verdicts(found: Mapping[str, Sequence[Times]]) -> Iterator[str]:
    """How the runner, recording, does by what it aims at, a line each where the others took part."""
    own, base, peer = (_quantiles(found.get(name, ()), 50) for name in ("runner", BASE, PEER))
    for size, runner, zenoh, dora in zip(SIZES, own, base, peer, strict=True):
        aim = f"{runner / zenoh:.2f} of bare Zenoh: {'reached' if runner <= AIM * zenoh else 'MISSED'} ({AIM})"
        ahead = f"{'ahead of' if runner < dora else 'BEHIND'} dora-rs ({runner / dora:.2f})"
        if not np.isnan(runner):
            yield f"{size:>9} bytes: " + ", ".join(
                text for text, ratio in ((aim, zenoh), (ahead, dora)) if not np.isnan(ratio)
            )


def _quantiles(rounds: Sequence[Times], percent: float) -> list[float]:
    """By size; NaN where there was no round."""
    return [
        float(np.median([np.percentile(times[str(size)], percent) for times in rounds] or [np.nan])) for size in SIZES
    ]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--messages", type=int, default=100, help="of each size and round")
    parser.add_argument("--only", nargs="*", choices=CONTENDERS, default=list(CONTENDERS))
    options = parser.parse_args()
    names = [name for name in options.only if not name.startswith(PEER) or importlib.util.find_spec("dora")]
    if len(names) < len(options.only):
        print("dora-rs is not installed: pip install -e '.[benchmarks]'")
    found: dict[str, list[Times]] = {name: [] for name in names}
    for _ in range(options.rounds):
        for name in names:
            with tempfile.TemporaryDirectory() as folder:
                found[name].append(CONTENDERS[name](options.messages, Path(folder)))
    print("\n".join([*lines(found), *verdicts(found), f"load {os.getloadavg()[0]:.1f}"]))


if __name__ == "__main__":
    main()
