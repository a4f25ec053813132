"""What is wrong with a simulated robot's camera and joints, as it is with every robot that nobody calibrated today."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose, random_direction
from stages.messages import SensorErrors
from stages.robots import Robot

_DEPTH = (0.01, 0.02)
"""Share by which all depths are too long or too short."""
_EXTRINSICS = 0.005, np.deg2rad(0.5)
"""Metres and radians by which the camera is not where it is said to be."""
_REGISTRATION = np.deg2rad(0.4)
"""Radians by which the depth camera's direction is off at most: 4 pixels."""
_EXPOSURE, _WHITE_BALANCE = 0.25, 0.07
"""Shares by which all colours, and each by itself, are too bright or too dark at most."""
_LEFT = 0.2
"""Share of all that which is left once somebody has calibrated the camera: 1 mm and 0.1 degrees."""


@dataclass(frozen=True)
class Miscalibration:
    """One robot's errors: always the same but for light, which is new at every look."""

    depth: float
    T_believed_true: Floats
    T_color_depth: Floats
    joints: Floats

    @staticmethod
    def draw(rng: np.random.Generator, robot: Robot, *, joints: float, calibrated: bool = False) -> Miscalibration:
        """A robot whose encoders are off by up to ``joints`` radians; in metres none is, a slide's is a spindle."""
        share = _LEFT if calibrated else 1.0
        turning = np.array([name in robot.posture and robot.body.turns(name) for name in robot.joint_names])
        return Miscalibration(
            depth=1 + share * float(rng.choice((-1, 1)) * rng.uniform(*_DEPTH)),
            T_believed_true=pose(
                exp_so3(share * _EXTRINSICS[1] * random_direction(rng)), share * _EXTRINSICS[0] * random_direction(rng)
            ),
            T_color_depth=pose(exp_so3(np.append(rng.uniform(-1, 1, 2), 0) * share * _REGISTRATION), np.zeros(3)),
            joints=turning * rng.uniform(-1, 1, len(turning)) * joints,
        )

    def at_a_look(self, rng: np.random.Generator) -> SensorErrors:
        """What is wrong with the next image."""
        exposure = rng.uniform(1 - _EXPOSURE, 1 + _EXPOSURE)
        return SensorErrors(
            depth=self.depth,
            T_believed_true=self.T_believed_true,
            T_color_depth=self.T_color_depth,
            joints=self.joints,
            gains=exposure * rng.uniform(1 - _WHITE_BALANCE, 1 + _WHITE_BALANCE, 3),
        )
