"""Renders what the detector learns from: ``python -m stages.devices.detector_data OUT.npz --layouts 600``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stages.devices.drops import distractors, random_layout, things
from stages.devices.simulated_camera import SimulatedCamera
from stages.devices.suites.tray import GOALS, sample_goal, sample_start
from stages.geometry.arrays import Floats
from stages.messages import Snapshot
from stages.perception.detection.trained.network import HEIGHT, WIDTH, fit
from stages.perception.detection.trained.training_images import Example, labelled, render_example, save_examples
from stages.perception.rendering.depth_noise import color_noise
from stages.perception.rendering.renderer import Camera, Item, Renderer
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue


def examples(
    catalogue: Catalogue, *, layouts: int, views: int, seed: int, like_robot: bool | None = None
) -> Iterator[Example]:
    """``layouts`` settled layouts, each seen ``views`` times; layout i depends on (seed, i) only."""
    known = things(catalogue)
    other = distractors(known, np.random.default_rng([seed, 0]), count=48)
    renderer = Renderer(WIDTH, HEIGHT)
    for index in range(layouts):
        rng = np.random.default_rng([seed, 1, index])
        layout = random_layout(known, other, rng)
        for _ in range(views):
            yield render_example(renderer, layout, rng, like_robot=like_robot)
    renderer.close()


def episode_examples(catalogue: Catalogue, *, images: int, seed: int) -> Iterator[Example]:
    """What the simulated robot's camera sees of the goal and start scenes of episodes, noise included."""
    robot = read_robot(ROBOT)
    camera, renderer = SimulatedCamera(catalogue, robot), Renderer(WIDTH, HEIGHT)
    joints, positions = tuple(robot.posture), np.array(list(robot.posture.values()))
    T_base_camera = robot.camera_pose(joints, positions)
    names = list(catalogue.objects)
    for index in range(images):
        rng = np.random.default_rng([seed, 2, index])
        goal = tuple(GOALS)[index // 2 % len(GOALS)]
        layout = (sample_goal if index % 2 else sample_start)(goal, catalogue, robot, rng)
        snapshot = Snapshot(
            names=tuple(layout),
            T_base_objects=np.stack(list(layout.values())),
            joint_names=joints,
            joint_positions=positions,
            time=0.0,
        )
        rgb, _ = camera.image(snapshot, T_base_camera)
        image, scale = fit(color_noise(rgb, rng))
        items = [Item(catalogue[name].mesh, pose) for name, pose in layout.items()]
        small = Camera(_scaled(robot.camera.K, scale), T_base_camera)
        identity, _ = renderer.instances(items, small)
        yield labelled(image, identity, items, [names.index(name) for name in layout], camera=small, rng=rng)
    renderer.close()
    camera.close()


def _scaled(K: Floats, scale: float) -> Floats:
    """Intrinsics of the image resized by ``scale``; pixel centres are at integer coordinates in both."""
    resized = K.copy()
    resized[:2] *= scale
    resized[:2, 2] += 0.5 * scale - 0.5
    return resized


def main() -> None:
    """Reads the command line and writes the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--catalogue", type=Path, default=BUILT_IN)
    parser.add_argument("--layouts", type=int, default=600)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--like-robot", action="store_true", help="the camera always where the robot's head is")
    parser.add_argument("--episode", action="store_true", help="scenes, camera and room of the simulated episode")
    arguments = parser.parse_args()
    catalogue = Catalogue.load(arguments.catalogue)
    made = list(_shown(_chosen(catalogue, arguments), arguments.layouts * arguments.views))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    save_examples(arguments.out, made, list(catalogue.objects))


def _chosen(catalogue: Catalogue, arguments: argparse.Namespace) -> Iterator[Example]:
    layouts, views, seed = arguments.layouts, arguments.views, arguments.seed
    if arguments.episode:
        return episode_examples(catalogue, images=layouts * views, seed=seed)
    like_robot = True if arguments.like_robot else None
    return examples(catalogue, layouts=layouts, views=views, seed=seed, like_robot=like_robot)


def _shown(made: Iterator[Example], total: int) -> Iterator[Example]:
    """Passes examples on and prints the progress every 300 images."""
    for number, example in enumerate(made, start=1):
        if number % 300 == 0:
            print(f"{number} of {total} images", flush=True)
        yield example


if __name__ == "__main__":
    main()
