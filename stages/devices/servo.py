"""The simulated robot's controllers: they follow, grip, watch what they measure, and brake."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from stages.devices.efforts import FILTER, Efforts, levers
from stages.geometry.arrays import Floats
from stages.messages import RobotCommand
from stages.messages.robot import Guard, Stopped
from stages.robots import Robot

PIECE = 0.05
"""Simulated seconds after which a motion lets others in."""
BRAKE = 0.1
"""Seconds in which the arm comes to a stand."""
_STROKE = 0.6
"""Seconds over which the fingers are commanded from closed to open, or back."""
_SETTLE = 0.3
"""Seconds in which the arm arrives, and the fingers stall or arrive, at most."""
_STILL = 0.005
"""Radians (metres) a second below which a joint stands."""


class Servo:
    """Position servos with feed-forward of velocities and of the efforts that the motion takes.

    Whatever else the motors must do is a force from outside. Only encoders and motor efforts are read.
    """

    def __init__(self, robot: Robot, model: Any, data: Any, step: Callable[[], None]) -> None:
        """``step`` lets one time step of the physics pass."""
        self._robot, self._model, self._data, self._step = robot, model, data, step
        self._timestep = float(model.opt.timestep)
        moved = {
            k: model.joint(model.actuator_trnid[k, 0]).name
            for k in range(model.nu)
            if model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_JOINT
        }
        self.actuators = {name: k for k, name in moved.items()}
        """By the joint that each moves."""
        self.fingers = np.array([k for k in range(model.nu) if moved.get(k) not in robot.posture])
        fingers = [model.joint(name) for name in robot.gripper.fingers]
        self._finger_positions, self._finger_dofs = (
            np.array([getattr(one, key)[0] for one in fingers]) for key in ("qposadr", "dofadr")
        )
        self._hand = model.body(robot.gripper.link).id
        self._efforts = Efforts(robot, tuple(robot.posture), balanced=True)
        self._unladen = np.zeros(model.nu)
        """What each actuator did before the fingers last moved: fingers that close may bear a thing already."""
        self._asked = False
        self.error = 0.0
        """Largest joint error of the newest command, radians."""
        self.force = 0.0
        """Largest force from outside that was felt meanwhile, as if it acted on the hand, newtons."""
        self.stopped: Stopped = ""
        """Why the newest command was not carried out to its end."""
        self.reason = ""

    def brake(self) -> None:
        """Has what is under way come to a stand at once; held things stay held."""
        self._asked = True

    def carry_out(self, command: RobotCommand) -> Iterator[None]:
        """Follows a trajectory, then drives the fingers; lets others in after every piece of it."""
        self._asked, self.error, self.force, self.stopped, self.reason = False, 0.0, 0.0, "", ""
        ended = False
        try:
            if len(command.times):
                yield from self._follow(command)
            if command.gripper_width is not None and not self.stopped:
                yield from self._grip(command.gripper_width)
            ended = not self.stopped
        finally:
            if not ended:
                self._stand()

    def opening(self) -> float:
        """Metres between the fingers."""
        gripper = self._robot.gripper
        positions = self._data.qpos[self._finger_positions].tolist()
        return sum(map(gripper.width, positions)) / len(positions)

    def grip(self, width: float) -> Floats:
        """What is commanded to the actuators of the fingers; their own range need not be that of the joints."""
        gain, bias = self._model.actuator_gainprm[self.fingers, 0], self._model.actuator_biasprm[self.fingers, 1]
        return self._robot.gripper.finger_position(width) * (-bias / gain)

    def _follow(self, command: RobotCommand) -> Iterator[None]:
        joints = [self._model.joint(name) for name in command.joint_names]
        actuators = np.array([self.actuators[name] for name in command.joint_names])
        addresses, dofs = (np.array([getattr(j, key)[0] for j in joints]) for key in ("qposadr", "dofadr"))
        gain = self._model.actuator_gainprm[actuators, 0]
        lag = -self._model.actuator_biasprm[actuators, 2] / gain
        targets, rates, efforts = self._resample(command)
        commanded = targets + lag * rates + efforts / gain
        arm = np.array([self._robot.body.turns(name) for name in command.joint_names])
        data = self._data
        # The weight of the arm itself is carried: one that stands and touches nothing takes no effort.
        lifts = command.guard is not None and command.guard.load > 0
        standing = self._unladen if lifts else data.actuator_force
        taken, felt = efforts + standing[actuators], np.zeros(len(actuators))
        for k in range(len(targets)):
            data.ctrl[actuators] = commanded[k]
            self._step()
            self.error = max(self.error, float(np.abs(data.qpos[addresses] - targets[k]).max()))
            felt += (data.actuator_force[actuators] - taken[k] - felt) * (self._timestep / FILTER)
            at_hand = np.abs(felt) / levers(self._model, data, self._hand, dofs)
            self.force = max(self.force, float(at_hand[arm].max()))
            if self._is_wrong(command.guard, (k + 1) * self._timestep):
                return
            if (k + 1) % round(PIECE / self._timestep) == 0:
                yield
                if self._is_wrong(None):
                    return
        data.ctrl[actuators] = targets[-1]
        yield from self._settle(dofs, command.guard)

    def _grip(self, width: float) -> Iterator[None]:
        """The fingers stall with limited force at what is between them."""
        gripper, self._unladen = self._robot.gripper, self._data.actuator_force.copy()
        start, end = self._data.ctrl[self.fingers].copy(), self.grip(width)
        stroke = np.abs(self.grip(gripper.open_width) - self.grip(gripper.closed_width)).max()
        pieces = int(np.ceil(np.abs(end - start).max() / stroke * _STROKE / PIECE))
        for k in range(1, pieces + 1):
            self._data.ctrl[self.fingers] = start + (end - start) * k / pieces
            yield from self._piece(None)
            if self.stopped:
                return
        yield from self._settle(self._finger_dofs, None)

    def _settle(self, dofs: NDArray[np.intp], guard: Guard | None) -> Iterator[None]:
        """Waits until joints stand, but not for long."""
        for _ in range(round(_SETTLE / PIECE)):
            yield from self._piece(guard)
            if self.stopped or np.abs(self._data.qvel[dofs]).max() < _STILL:
                return

    def _piece(self, guard: Guard | None) -> Iterator[None]:
        for _ in range(round(PIECE / self._timestep)):
            self._step()
        yield
        self._is_wrong(guard)

    def _is_wrong(self, guard: Guard | None, seconds: float = 0.0) -> bool:
        """Whether the robot must stop, and why; ``seconds`` after the motion began."""
        if self._asked:
            self.stopped, self.reason = "stop", "as asked"
        elif guard is not None:
            broken = guard.broken(opening=self.opening(), force=self.force, error=self.error, seconds=seconds)
            self.stopped, self.reason = broken or ("", "")
        return bool(self.stopped)

    def _stand(self) -> None:
        """Every joint slows down evenly and then stays."""
        moving = np.setdiff1d(np.arange(self._model.nu), self.fingers)
        joints = self._model.actuator_trnid[moving, 0]
        position = self._data.qpos[self._model.jnt_qposadr[joints]].copy()
        rate = self._data.qvel[self._model.jnt_dofadr[joints]].copy()
        steps = round(BRAKE / self._timestep)
        lag = -self._model.actuator_biasprm[moving, 2] / self._model.actuator_gainprm[moving, 0]
        for k in range(steps):
            slower = rate * (1 - (k + 1) / steps)
            position += slower * self._timestep
            self._data.ctrl[moving] = position + lag * slower
            self._step()

    def _resample(self, command: RobotCommand) -> tuple[Floats, Floats, Floats]:
        """The trajectory at every time step of the simulation, and the efforts that it takes."""
        times = command.times
        if len(times) < 2:
            return command.positions, command.velocities, np.zeros_like(command.positions)
        spline = CubicHermiteSpline(times, command.positions, command.velocities)
        steps = np.minimum(np.arange(1, round(times[-1] / self._timestep) + 1) * self._timestep, times[-1])
        efforts = self._taken(command, np.gradient(command.velocities, times, axis=0))
        return spline(steps), spline(steps, 1), np.stack([np.interp(steps, times, one) for one in efforts.T], axis=1)

    def _taken(self, command: RobotCommand, accelerations: Floats) -> Floats:
        """T x J, newton metres (newtons) that a trajectory takes; joints that are not named stand as at home."""
        home = self._robot.posture
        named = [list(home).index(name) for name in command.joint_names]
        q, v, a = np.array(list(home.values())), *np.zeros((2, len(home)))
        result = np.zeros_like(command.positions)
        for k, now in enumerate(zip(command.positions, command.velocities, accelerations, strict=True)):
            q[named], v[named], a[named] = now
            result[k] = self._efforts.taken(q, v, a)[named]
        return result
