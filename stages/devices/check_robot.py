"""Tries a robot's description: ``python -m stages.devices.check_robot FILE [PICTURE.png]``."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from runner.contract import Refused
from stages.devices.simulated_camera import room
from stages.geometry.arrays import Floats
from stages.geometry.camera import intrinsics, project
from stages.geometry.poses import pose
from stages.messages.arrays import Rgb
from stages.perception.rendering.renderer import Camera, Item, Renderer
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.motion import restarts, solve_ik
from stages.robots import Robot, read_robot

_ABOVE = 0.05
"""Metres above the table at which fingertips are tried."""
_POSTURES = 200
_OFTEN = 0.5
"""Share of random postures in which two links that touch are named."""
_ASIDE = (1.6, -1.3, 1.0)
"""Where the picture from outside is taken, from the robot's base, metres."""


def report(robot: Robot) -> Iterator[str]:
    """What the description comes to, line by line."""
    world = CollisionWorld(robot, robot.table, {})
    rng = np.random.default_rng(0)
    close = world.contacts(robot.home)
    touching = Counter(pair for _ in range(_POSTURES) for pair in world.contacts(rng.uniform(world.lower, world.upper)))
    often = [f"{a} and {b}" for (a, b), count in touching.items() if count > _OFTEN * _POSTURES]
    places = list(product(np.linspace(*robot.x, 6), np.linspace(*robot.y, 7)))
    reached = [place for place in places if _reaches(world, place)]
    corners = np.array([[x, y, robot.table.height] for x in robot.x for y in robot.y])
    seen = project(corners @ robot.T_camera_base[:3, :3].T + robot.T_camera_base[:3, 3], robot.camera.K)
    inside = ((seen >= 0) & (seen < robot.camera.size)).all()
    names = robot.gripper.posture(0.0)
    yield f"joints   {len(robot.joints)} moved, {len(robot.still)} still, {len(names)} of the gripper"
    yield f"at home  {'free' if not close else f'too close: {sorted(close)}'}"
    yield f"touching {', '.join(often) or 'no two links'} in more than {_OFTEN:.0%} of random postures"
    yield f"reach    {len(reached)} of {len(places)} places of the workspace, from the top"
    yield f"camera   {'sees all' if inside else 'does not see all'} of the workspace"
    for number, q in enumerate(robot.views, 1):
        close = world.contacts(q)
        yield f"view {number}   {'free' if not close else f'too close: {sorted(close)}'}"


def picture(robot: Robot) -> Rgb:
    """The robot at home as its camera sees it and from outside, H x 2W x 3."""
    renderer = Renderer(*robot.camera.size)
    links = robot.links(tuple(robot.posture), np.array(list(robot.posture.values())))
    items = [*room(robot.table, robot.floor), *(Item(mesh, T) for mesh, T in links)]
    outside = intrinsics(0.8 * robot.camera.size[0], *robot.camera.size)
    at_home = robot.camera_pose(tuple(robot.posture), np.array(list(robot.posture.values())))
    views = [Camera(robot.camera.K, at_home), Camera(outside, _aside(robot))]
    images = [renderer.color(items, view, background=(214, 218, 222)) for view in views]
    renderer.close()
    return np.hstack(images)


def _reaches(world: CollisionWorld, place: tuple[float, float]) -> bool:
    """Whether the open hand gets there from above in one of four directions."""
    for yaw in np.linspace(0, np.pi, 4, endpoint=False):
        approach, closing = np.array([0.0, 0.0, -1.0]), np.array([np.cos(yaw), np.sin(yaw), 0.0])
        R = np.column_stack([approach, closing, np.cross(approach, closing)])
        T = pose(R, np.array([*place, world.robot.table.height + _ABOVE]))
        seeds = restarts(world, np.random.default_rng(0), world.robot.home, extra=6)
        if solve_ik(world, T, seeds=seeds) is not None:
            return True
    return False


def _aside(robot: Robot) -> Floats:
    """A camera that looks at the robot and its table, T_base_camera (4 x 4)."""
    target = np.array([0.3, 0.0, robot.table.height])
    eye = target + _ASIDE
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return pose(np.column_stack([right, np.cross(forward, right), forward]), eye)


def main() -> None:
    """Reads the command line, prints the report and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("description", type=Path)
    parser.add_argument("picture", type=Path, nargs="?")
    arguments = parser.parse_args()
    try:
        robot = read_robot(arguments.description)
        print("\n".join(report(robot)))
    except Refused as reason:
        raise SystemExit(str(reason)) from None
    if arguments.picture:
        cv2.imwrite(str(arguments.picture), picture(robot)[..., ::-1])


if __name__ == "__main__":
    main()
