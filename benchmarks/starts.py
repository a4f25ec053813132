"""From `runner up` to ready, and whether a cold start loses anything: `python -m benchmarks.starts [--times 200]`.

First the default graph: how long after its start every process is ready, and how much of that the imports and set-up of
its stages take without a runner. Then, again and again, a small graph whose source speaks the moment it may: each
recording must be COMPLETE and hold every message.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from runner.graph.graph import Graph, load_graph, node_entry
from runner.process.children import ENVIRONMENT
from runner.recording.recording import Recording

_GRAPH = Path(__file__).parents[1] / "graph.yaml"
_MESSAGES = 100


def seconds_to_ready(graph: Path, folder: Path) -> float:
    """Wall time from the command to the line that says that all processes are ready; the graph is ended then."""
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--recordings", str(folder)]
    began = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        for line in run.stdout:
            if re.search(r"processes are ready", line):
                taken = time.monotonic() - began
                run.terminate()
                run.stdout.read()
                return taken
    raise SystemExit(f"{graph} never became ready")


def seconds_to_construct(graph: Graph) -> float:
    """Wall time to import and set up every stage of a graph, each in a process, all at once and without a runner."""
    code = (
        "import json, sys; from runner.graph.graph import node_from_entry;"
        "node_from_entry(sys.argv[1], json.loads(sys.argv[2])).construct()"
    )
    began = time.monotonic()
    tasks = [(node.name, json.dumps(node_entry(node))) for node in graph.nodes.values() for _ in range(node.replicas)]
    environment = {**os.environ, **ENVIRONMENT}
    children = [subprocess.Popen([sys.executable, "-c", code, *task], env=environment) for task in tasks]
    for child in children:
        child.wait()
    return time.monotonic() - began


def cold_start(folder: Path) -> bool:
    """Whether a recording of a graph that speaks at once is complete and holds all of it."""
    seconds = _MESSAGES / 1000
    stages = {
        "speaker": {"stage": "benchmarks.recording_stages:Speaker", "config": {"hertz": 1000, "seconds": seconds}}
    }
    stages["ender"] = {"stage": "benchmarks.recording_stages:Camera", "config": {"hertz": 30, "seconds": seconds}}
    graph = folder / "graph.yaml"
    graph.write_text(json.dumps({"name": "start", "stages": stages}))
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--recordings", str(folder)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    (path,) = folder.glob("*.mcap")
    words = sum(message.topic == "speaker/word" for message in Recording(path).messages.values())
    return done.returncode == 0 and words == _MESSAGES


def main() -> None:
    """Prints the times of the default graph and how many cold starts were whole."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3, help="of the default graph")
    options = parser.parse_args()
    ready: list[float] = []
    bare: list[float] = []
    for _ in range(options.rounds):
        with tempfile.TemporaryDirectory() as folder:
            bare.append(seconds_to_construct(load_graph(_GRAPH)))
            ready.append(seconds_to_ready(_GRAPH, Path(folder)))
    print(f"default graph: ready after {median(ready):.1f} s, imports and set-up alone {median(bare):.1f} s")
    print(f"the runner adds {median(ready) - median(bare):.1f} s")
    whole = 0
    for _ in range(options.times):
        with tempfile.TemporaryDirectory() as folder:
            whole += cold_start(Path(folder))
    print(f"{whole} of {options.times} cold starts lost nothing")


if __name__ == "__main__":
    main()
