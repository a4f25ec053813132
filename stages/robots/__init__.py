"""Robots as descriptions: a YAML file says all that is known of one, docs/robots.md how to write it."""

from stages.robots.reading import read_robot
from stages.robots.robot import BESIDE, BUILT_IN, Camera, Gripper, Robot, Table

__all__ = ["BESIDE", "BUILT_IN", "Camera", "Gripper", "Robot", "Table", "read_robot"]
