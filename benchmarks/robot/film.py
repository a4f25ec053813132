"""An episode as a film: `python -m benchmarks.film RECORDING OUT.webp`.

The simulated world is given again what it was given in the recording, in the same order, and drawn as it moves, from
beside the table. Where it does not answer as it did then, the film is not made.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from runner.contract import Message
from runner.graph.reading import graph_from_json
from runner.recording.recording import Recording, opened
from stages.devices.simulated_camera import SimulatedCamera
from stages.estimate import Quiet
from stages.messages import Rgb, RobotState
from stages.perception.rendering.contact_sheet import looking_at
from stages.robots import read_robot
from stages.scene.catalogue import Catalogue
from stages.world import World

_EYE, _AT = np.array([1.5, -0.7, 1.5]), np.array([0.68, 0.02, 0.82])
"""Where the film is taken from, and what is in its middle, metres in the base frame."""
_SPEED = 8.0
"""Times as fast as the robot moves."""
_RATE = 10.0
"""Frames a second."""
_SIZE = (480, 360)


def main() -> None:
    """Writes the film and says how large it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    frames = list(film(options.recording))
    first, *others = (Image.fromarray(frame).resize(_SIZE, Image.Resampling.LANCZOS) for frame in frames)
    duration = [round(1000 / _RATE)] * len(others) + [2000]
    first.save(options.out, save_all=True, append_images=others, duration=duration, loop=0, quality=55, method=6)
    print(f"{options.out}: {len(frames)} frames, {options.out.stat().st_size / 1e6:.1f} MB")


def film(path: Path) -> Iterator[Rgb]:
    """Frames (H x W x 3, 8 bit) of a recorded episode; raises SystemExit where the world goes another way."""
    recording = Recording(path)
    graph = graph_from_json(recording.run["graph"], str(path))
    config = graph.nodes["world"].config
    world, robot = World(config), read_robot(config.robot)
    camera, ctx = SimulatedCamera(Catalogue.shared(config.catalogue), robot), Quiet()
    drawn = -np.inf
    for step in recording.steps:
        if step.stage != "world" or not step.consumed:
            continue
        ((_, id),) = step.consumed
        answer = getattr(world, step.handler)(opened(graph, recording.recorded(id)), ctx)
        for state in (answer,) if isinstance(answer, Message) else answer or ():
            now = world.snapshot("film")
            if now.time >= drawn + _SPEED / _RATE:
                drawn = now.time
                yield camera.image(now, looking_at(_EYE, _AT))[0]
            if isinstance(state, RobotState):
                then = opened(graph, recording.recorded(step.emitted[0]))
                if not isinstance(then, RobotState) or not np.array_equal(then.positions, state.positions):
                    raise SystemExit(f"{path}: the world does not do what it did at {id}")


if __name__ == "__main__":
    main()
