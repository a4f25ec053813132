"""The suite ``biased``: sensors and joints that are off, light that varies, and a table that is not yesterday's."""

from __future__ import annotations

import numpy as np

from stages.devices.suites.draft import Draft
from stages.devices.suites.suite import Drawn, Kind, graspable, put_somewhere, shift
from stages.devices.suites.wild import FIXED
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose
from stages.messages import SensorErrors
from stages.robots import Table

_DEPTH = (0.01, 0.02)
"""Share by which all depths are too long or too short."""
_EXTRINSICS = 0.005, np.deg2rad(0.5)
"""Metres and radians by which the camera is not where it is said to be."""
_REGISTRATION = np.deg2rad(0.4)
"""Radians by which the depth camera's direction is off at most: 4 pixels."""
_JOINTS = np.deg2rad(0.3)
"""Radians by which encoders are off at most; metres for none, the torso's is a spindle."""


class Biased(Drawn):
    """5 to 7 objects, seen and handled by a robot that is not calibrated."""

    def choose(self, rng: np.random.Generator) -> None:
        """The objects, the table and what is wrong."""
        fixed = [FIXED[0]] if rng.random() < 0.5 else []
        self.names = (*fixed, *rng.permutation(graspable(self.catalogue)).tolist()[: int(rng.integers(5, 8))])
        dx, _, dz = shift(self.robot).tolist()
        depth, front = float(rng.uniform(0.55, 0.85)), float(rng.uniform(0.40, 0.48))
        self.table = Table(
            center=(dx + front + depth / 2, float(rng.uniform(-0.05, 0.05))),
            size=(depth, float(rng.uniform(1.0, 1.4))),
            height=dz + float(rng.uniform(0.66, 0.74)),
        )
        self._depth = 1 + float(rng.choice((-1, 1)) * rng.uniform(*_DEPTH))
        self._T_believed_true = pose(exp_so3(_EXTRINSICS[1] * _direction(rng)), _EXTRINSICS[0] * _direction(rng))
        self._T_color_depth = pose(exp_so3(np.append(rng.uniform(-1, 1, 2), 0) * _REGISTRATION), np.zeros(3))
        posture, body = self.robot.posture, self.robot.body
        turning = np.array([name in posture and body.turns(name) for name in self.robot.joint_names])
        self._joints = turning * rng.uniform(-_JOINTS, _JOINTS, len(turning))

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """As in the wild."""
        for name in self.names:
            carried = 0.0 if name in FIXED else 0.5 if kind == "goal" else 0.3
            put_somewhere(draft, name, rng, carried=carried, beside=0.25)

    def errors(self, rng: np.random.Generator) -> SensorErrors:
        """What is off, always by the same; exposure and white balance are new at every look."""
        return SensorErrors(
            depth=self._depth,
            T_believed_true=self._T_believed_true,
            T_color_depth=self._T_color_depth,
            joints=self._joints,
            gains=rng.uniform(0.75, 1.25) * rng.uniform(0.93, 1.07, 3),
        )


def _direction(rng: np.random.Generator) -> Floats:
    """A random unit vector."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
