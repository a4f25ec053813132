"""Scenes for tests of planning: the robot at its table with a few catalogue objects."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.planning.motion.collision import CollisionWorld
from stages.robots import BUILT_IN, read_robot
from stages.scene.catalogue import Catalogue

CATALOGUE_FILE = Path(__file__).parents[3] / "stages" / "scene" / "catalogue.yaml"
ROBOT = read_robot(BUILT_IN)
TABLE = ROBOT.table


@lru_cache(maxsize=1)
def catalogue() -> Catalogue:
    return Catalogue.load(CATALOGUE_FILE)


def standing(
    name: str, x: float, y: float, *, yaw: float = 0.0, height: float = TABLE.height, resting: int = 0
) -> Floats:
    """T_base_object of an object in one of its resting poses, upright by default."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = catalogue()[name].resting[resting]
    bottom = (catalogue()[name].mesh.vertices @ R[2]).min()
    return pose(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ R, np.array([x, y, height - bottom]))


def world(carried: str, **poses: Floats) -> CollisionWorld:
    objects = {name: (catalogue()[name], T) for name, T in poses.items()}
    return CollisionWorld(ROBOT, TABLE, objects, carried=carried)
