"""The whole demonstration across ROS 2: `python -m benchmarks.ros2_lab 0 1 2 ...`.

For each seed a router, a simulated lab behind it (a process that knows nothing of the product's stages and messages)
and `runner up graphs/arm.yaml`. The lab lays the goal out, calls the service that has it taught, lays the start scene
out and has the goal restored. Prints a table that is judged by where the lab's objects really are.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.robot.episodes import HEADER, Episode, messages, row, totals
from benchmarks.robot.ros2_lab import camera
from benchmarks.robot.ros2_lab.bench import Bench
from benchmarks.robot.ros2_lab.controllers import Arm, Gripper
from benchmarks.robot.ros2_lab.wire import Interfaces, Speaker, free_port, open_router
from runner.recording.recording import Recording
from runner.testing import finish, read_until, start_graph
from stages.messages import Goal, Outcome, Snapshot, Task, Verdict
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.truth import Truth

ROOT = Path(__file__).parents[3]
GOAL = "breakfast"
_SECONDS = {"ready": 600.0, "teach": 600.0, "restore": 7200.0}
"""How long the graph may take to start, and to teach and restore; where processors are busy, all of it takes longer."""
Layouts = list[dict[str, Any]]


def lab(seed: int, endpoint: str) -> None:
    """The lab's process: does what stands on its standard input, line by line, and answers with JSON."""
    bench = Bench(seed)
    node = Speaker(endpoint, "ur5e", Interfaces())
    arm, _ = Arm(node, bench), Gripper(node, bench)
    here, there = multiprocessing.Pipe()
    context = multiprocessing.get_context("spawn")
    watching = context.Process(target=camera.serve, args=(seed, endpoint, there), daemon=True)
    watching.start()
    threading.Thread(target=_show, args=(bench, here), daemon=True).start()
    bench.start()
    for line in sys.stdin:
        word, _, rest = line.strip().partition(" ")
        answer: Any = None
        if word == "arrange":
            bench.arrange(rest)
        elif word == "call":
            response = node.call(rest, "std_srvs/srv/Trigger", seconds=_SECONDS[rest.split("/")[2]])
            answer = None if response is None else [bool(response.success), response.message]
        elif word == "truth":
            answer = {name: T.tolist() for name, T in bench.truth().items()}
        elif word == "health":
            answer = {"slow": bench.slow, "protective": arm.protective}
        print(json.dumps(answer), flush=True)
    bench.stop()
    watching.terminate()
    node.close()


def _show(bench: Bench, pipe: Any) -> None:
    """Tells the camera what there is to be seen, whenever it asks."""
    with contextlib.suppress(EOFError, OSError):  # the camera has ended
        while True:
            pipe.recv()
            pipe.send(bench.picture())


class Referee:
    """Whoever lays scenes out and looks at the truth."""

    def __init__(self, seed: int, port: int) -> None:
        command = [sys.executable, "-m", "benchmarks.robot.ros2_lab", str(seed), "--lab", str(port)]
        self._lab = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, line: str) -> Any:
        """What the lab answers."""
        reader, writer = self._lab.stdout, self._lab.stdin
        assert reader is not None and writer is not None
        with contextlib.suppress(BrokenPipeError):
            writer.write(f"{line}\n")
            writer.flush()
        answer = reader.readline()
        if not answer:
            raise SystemExit(f"the lab ended with exit status {self._lab.wait()}")
        return json.loads(answer)

    def close(self) -> None:
        """Ends the lab."""
        self._lab.communicate()


def run(seed: int, folder: Path, settings: Sequence[str]) -> tuple[Episode, dict[str, Any]]:
    """One demonstration; what the lab says of itself goes with it."""
    port = free_port()
    router = open_router(port)
    endpoint = f"tcp/127.0.0.1:{port}"
    referee = Referee(seed, port)
    links = [f"{stage}.link.router={endpoint}" for stage in ("camera", "arm", "ros2")]
    goals = tempfile.TemporaryDirectory()
    began = time.monotonic()
    graph = start_graph(
        ROOT / "graphs" / "arm.yaml",
        *links,
        "arm.armed=true",
        "arm.calibrated=true",
        "arm.controllers.efforts=true",
        f"goals.folder={goals.name}",
        *settings,
        folder=folder,
    )
    try:
        printed = read_until(graph, "processes are ready", seconds=_SECONDS["ready"])
        layouts: Layouts = []
        answer: Any = None
        for kind, service in (("goal", "teach"), ("start", "restore")):
            referee.ask(f"arrange {kind}")
            layouts.append(referee.ask("truth"))
            answer = referee.ask(f"call /scene_programming/{service}/{GOAL}")
        layouts.append(referee.ask("truth"))
        health = referee.ask("health")
    finally:
        graph.terminate()
        referee.close()
    recorded = finish(graph, folder, before=printed, seconds=_SECONDS["ready"])
    router.close()
    goals.cleanup()
    seconds = time.monotonic() - began
    assert recorded.recording is not None, recorded.output
    success, reason = answer or (False, "no answer")
    return judged(recorded.recording, layouts, seed=seed, code=int(not success), seconds=seconds, reason=reason), health


def judged(path: Path, layouts: Layouts, *, seed: int, code: int, seconds: float, reason: str) -> Episode:
    """An episode as its recording tells it, and the lab's truth."""
    recording = Recording(path)
    verdict, goal = ([None, *messages(recording, Verdict)][-1], [None, *messages(recording, Goal)][-1])
    outcomes = tuple(messages(recording, Outcome))
    began = next((task.current for task in messages(recording, Task)), None)
    purposes = (f"goal {GOAL}", f"restore {GOAL}", "end")
    snapshots = [_snapshot(*one) for one in zip(purposes, layouts, strict=True)]
    judgement = Truth(Catalogue.load(BUILT_IN)).judge(snapshots, goal, verdict, outcomes, began)
    return Episode(seed, code, seconds, verdict, judgement, outcomes, recording.verdict.complete, reason, path)


def _snapshot(purpose: str, layout: dict[str, Any]) -> Snapshot:
    poses = np.array(list(layout.values()))
    return Snapshot(
        names=tuple(layout),
        T_base_objects=poses,
        joint_names=(),
        joint_positions=np.zeros(0),
        time=0.0,
        purpose=purpose,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="STAGE.KEY=VALUE")
    parser.add_argument("--folder", type=Path, default=ROOT / "recordings", help="where recordings land")
    parser.add_argument("--lab", type=int, metavar="PORT", help="be the lab of the seed, at a router at that port")
    options = parser.parse_args(arguments)
    if options.lab is not None:
        lab(options.seeds[0], f"tcp/127.0.0.1:{options.lab}")
        return
    print(HEADER)
    episodes: list[Episode] = []
    for seed in options.seeds:
        options.folder.mkdir(exist_ok=True)
        own = Path(tempfile.mkdtemp(prefix=f"ros2-lab-{seed}-", dir=options.folder))
        episode, health = run(seed, own, options.settings)
        episodes.append(episode)
        print(row(episode), flush=True)
        print(f"seed {seed}: {health}", file=sys.stderr)
    print(f"\n{totals(episodes)}")


if __name__ == "__main__":
    main()
