"""The lab's controllers: joint states, a trajectory controller with tolerances, a gripper, a protective stop."""

from __future__ import annotations

import time
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from benchmarks.robot.ros2_lab.bench import Bench
from benchmarks.robot.ros2_lab.wire import Server, Speaker, stamp, transforms

FOLLOW, GRIP = "control_msgs/action/FollowJointTrajectory", "control_msgs/action/GripperCommand"
ARM, GRIPPER = "/scaled_joint_trajectory_controller/follow_joint_trajectory", "/robotiq_gripper_controller/gripper_cmd"
FINGER = "robotiq_85_left_knuckle_joint"
_SUCCEEDED, _CANCELED, _ABORTED = 4, 5, 6
_PATH, _GOAL = -4, -5
_STATES_STEPS, _TOOL_STEPS, _FEEDBACK_STEPS = 4, 16, 25
"""Steps of 2 ms: 125, 31 and 20 Hz."""
_BRAKE, _RAMP, _STALL = 0.1, 0.6, 0.15
_TREMBLE = 0.005
"""Radians within which a finger stands."""
_POSITION_NOISE, _EFFORT_NOISE = 1e-5, 0.1
"""Radians, newton metres."""
_LIMIT, _LIMIT_STEPS = 0.98, 25
"""Share of a motor's torque, and for how long, at which the robot stops itself."""


class Arm:
    """Follows trajectories from where it was commanded to be; whatever ends them, it holds its position."""

    def __init__(self, node: Speaker, bench: Bench) -> None:
        self._bench, self._node, self._rng = bench, node, np.random.default_rng(5)
        model, robot = bench.model, bench.robot
        self._joints = list(robot.joints)
        ids = [model.joint(name).id for name in self._joints]
        self._q, self._v = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
        self._motors = np.array([int(np.flatnonzero(model.actuator_trnid[:, 0] == i)[0]) for i in ids])
        self._lag = -model.actuator_biasprm[self._motors, 2] / model.actuator_gainprm[self._motors, 0]
        self._limits = model.actuator_forcerange[self._motors, 1]
        self._finger = model.joint(robot.gripper.fingers[0]).qposadr[0]
        self._hold = bench.data.qpos[self._q].copy()
        bench.data.ctrl[self._motors] = self._hold
        self._goal: Any = None
        self._path: CubicHermiteSpline | None = None
        self._began = 0.0
        self._ends: tuple[int, int, str] | None = None
        self._overloaded = self._steps = 0
        self.protective = ""
        self._states = node.publisher("/joint_states", "sensor_msgs/msg/JointState")
        self._tool = node.publisher("/tf", "tf2_msgs/msg/TFMessage")
        self._server = Server(node, ARM, FOLLOW, self._accept, self._cancel)
        bench.each.append(self._step)

    def _accept(self, goal: Any) -> bool:
        points = goal.trajectory.points
        times = np.array([one.time_from_start.sec + one.time_from_start.nanosec / 1e9 for one in points])
        known = list(goal.trajectory.joint_names) == self._joints
        if self.protective or not known or not len(points) or times[0] <= 0 or (np.diff(times) <= 0).any():
            return False
        with self._bench.lock:
            if self._path is not None:
                self._end(_ABORTED, 0, "preempted by a new goal")
            positions = np.vstack([self._hold, *(one.positions for one in points)])
            velocities = np.vstack([np.zeros(len(self._hold)), *(one.velocities for one in points)])
            self._path = CubicHermiteSpline(np.append(0.0, times), positions, velocities)
            self._goal, self._began, self._ends = goal, self._bench.data.time, None
        return True

    def _cancel(self) -> None:
        self._ends = _CANCELED, 0, "canceled"

    def _step(self) -> None:
        self._steps += 1
        self._guard()
        if self._path is not None:
            self._follow(self._path)
        if self._steps % _STATES_STEPS == 0:
            self._publish()
        if self._steps % _TOOL_STEPS == 0:
            self._tool(transforms(self._node.new, "base", {"wrist_3_link": self._bench.pose("wrist_3_link")}))

    def _guard(self) -> None:
        share = np.abs(self._bench.data.actuator_force[self._motors]) / self._limits
        self._overloaded = self._overloaded + 1 if share.max() > _LIMIT else 0
        if self._overloaded > _LIMIT_STEPS and not self.protective:
            self.protective = f"Protective stop: {self._joints[int(share.argmax())]} exceeds its torque"
            self._ends = _ABORTED, -100, self.protective

    def _follow(self, path: CubicHermiteSpline) -> None:
        data, elapsed = self._bench.data, self._bench.data.time - self._began
        last = float(path.x[-1])
        now = min(elapsed, last)
        target, rate = path(now), path(now, 1) * (elapsed < last)
        off = np.abs(data.qpos[self._q] - target)
        if self._ends is not None:
            self._brake(rate)
            self._end(*self._ends)
            return
        self._hold = target
        data.ctrl[self._motors] = target + self._lag * rate
        if self._beyond(off, self._goal.path_tolerance) and elapsed < last:
            self._ends = _ABORTED, _PATH, f"{self._worst(off)} violates its path tolerance"
        elif elapsed >= last and not self._beyond(off, self._goal.goal_tolerance):
            self._end(_SUCCEEDED, 0, "")
        elif elapsed > last + self._goal.goal_time_tolerance.sec + self._goal.goal_time_tolerance.nanosec / 1e9:
            self._ends = _ABORTED, _GOAL, f"{self._worst(off)} violates its goal tolerance"
        elif self._steps % _FEEDBACK_STEPS == 0:
            actual = {"positions": data.qpos[self._q].copy()}
            self._server.tell(joint_names=self._joints, desired={"positions": target}, actual=actual)

    def _brake(self, rate: Any) -> None:
        """A short way on, on which the joints come to a stand."""
        self._hold = self._bench.data.qpos[self._q] + rate * _BRAKE / 2
        self._bench.data.ctrl[self._motors] = self._hold

    def _end(self, status: int, code: int, text: str) -> None:
        self._path = self._ends = None
        self._server.end(status, error_code=code, error_string=text)

    def _beyond(self, off: Any, tolerances: Any) -> bool:
        return any(off[self._joints.index(one.name)] > one.position > 0 for one in tolerances)

    def _worst(self, off: Any) -> str:
        return f"{self._joints[int(off.argmax())]}, {off.max():.3f} rad off,"

    def _publish(self) -> None:
        data, count = self._bench.data, len(self._joints)
        q = np.append(data.qpos[self._q], data.qpos[self._finger]) + self._rng.normal(0, _POSITION_NOISE, count + 1)
        torque = data.actuator_force[self._motors] + data.qfrc_gravcomp[self._v]
        effort = np.append(torque + self._rng.normal(0, _EFFORT_NOISE, count), 0.0)
        velocity = np.append(data.qvel[self._v], 0.0)
        header = {"stamp": stamp(time.time_ns()), "frame_id": "base_link"}
        names = [*self._joints, FINGER]
        new = self._node.new
        self._states(
            new("sensor_msgs/msg/JointState", header=header, name=names, position=q, velocity=velocity, effort=effort)
        )


class Gripper:
    """Closes with limited force, and stalls at what is between the fingers."""

    def __init__(self, node: Speaker, bench: Bench) -> None:
        self._bench = bench
        model = bench.model
        self._motors = np.flatnonzero(model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT)
        self._scale = -model.actuator_biasprm[self._motors, 1] / model.actuator_gainprm[self._motors, 0]
        self._finger = model.joint(bench.robot.gripper.fingers[0])
        self._from = self._to = self._began = 0.0
        self._moving = self._canceled = False
        self._stands, self._since = 0.0, 0.0
        """Where the finger stands, and since when."""
        self._server = Server(node, GRIPPER, GRIP, self._accept, self._cancel)
        bench.each.append(self._step)

    def _accept(self, goal: Any) -> bool:
        with self._bench.lock:
            if self._moving:
                self._server.end(_ABORTED)
            self._from, self._to = self._commanded(), float(goal.command.position)
            self._began, self._moving, self._canceled = self._bench.data.time, True, False
        return True

    def _cancel(self) -> None:
        self._canceled = True

    def _commanded(self) -> float:
        return float((self._bench.data.ctrl[self._motors] / self._scale)[0])

    def _step(self) -> None:
        if not self._moving:
            return
        data = self._bench.data
        share = min((data.time - self._began) / _RAMP, 1.0)
        data.ctrl[self._motors] = (self._from + (self._to - self._from) * share) * self._scale
        position = float(data.qpos[self._finger.qposadr[0]])
        # Not by its rate: a finger trembles on what it holds.
        if share < 1.0 or abs(position - self._stands) > _TREMBLE:
            self._stands, self._since = position, data.time
        if self._canceled or data.time - self._since > _STALL:
            self._moving = False
            reached = abs(position - self._to) < 0.02
            status = _CANCELED if self._canceled else _SUCCEEDED
            self._server.end(status, position=position, stalled=not reached, reached_goal=reached)
