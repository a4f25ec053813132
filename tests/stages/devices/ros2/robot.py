"""A robot of ROS 2 nodes without physics: joint states, an arm and a gripper that do as they are told, or do not."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from stages.devices.ros2.node import Node
from stages.devices.ros2.services import Request, serve
from stages.devices.ros2.settings import Controllers
from stages.robots import Robot, read_robot

ROBOT = Path(__file__).parents[4] / "stages" / "robots" / "ur5e.yaml"
FOLLOW = "control_msgs/action/FollowJointTrajectory"
JOINTS = "sensor_msgs/msg/JointState"
WHERE = Controllers(efforts=False)
EXECUTING, SUCCEEDED, CANCELED, ABORTED = 2, 4, 5, 6
_PERIOD = 0.01
_GRIPPER_SPEED = 4.0
"""Radians per second."""


class Action:
    """An action server of one goal at a time; ``accepts`` says whether it takes goals, ``silent`` keeps the result."""

    def __init__(self, node: Node, name: str, type: str) -> None:
        self._node, self._type = node, type
        self.goals: list[Any] = []
        self.accepts, self.silent, self.canceling, self.refuses = True, False, False, False
        self._waiting: Request | None = None
        self._result: tuple[int, dict[str, Any]] | None = None
        self._changing = threading.Lock()
        parts = f"{name}/_action"
        serve(node, f"{parts}/send_goal", f"{type}_SendGoal", self._on_goal)
        serve(node, f"{parts}/get_result", f"{type}_GetResult", self._on_result)
        serve(node, f"{parts}/cancel_goal", "action_msgs/srv/CancelGoal", self._on_cancel)

    @property
    def busy(self) -> bool:
        return bool(self.goals) and self._result is None

    def end(self, status: int, **result: Any) -> None:
        with self._changing:
            self._result = status, result
            self._answer()

    def _on_goal(self, request: Request) -> None:
        if self.accepts:
            self._result, self.canceling = None, False
            self.goals.append(request.message.goal)
        request.answer(self._node.types.new(f"{self._type}_SendGoal_Response", accepted=self.accepts))

    def _on_result(self, request: Request) -> None:
        with self._changing:
            self._waiting = request
            self._answer()

    def _on_cancel(self, request: Request) -> None:
        new, response = self._node.types.new, "action_msgs/srv/CancelGoal_Response"
        if self.refuses:
            request.answer(new(response, return_code=1))
            return
        self.canceling = True
        request.answer(new(response, goals_canceling=[request.message.goal_info]))

    def _answer(self) -> None:
        if self._waiting is not None and self._result is not None and not self.silent:
            status, result = self._result
            new = self._node.types.new
            response = new(
                f"{self._type}_GetResult_Response", status=status, result=new(f"{self._type}_Result", **result)
            )
            self._waiting.answer(response)
            self._waiting = None


class FakeRobot:
    """Publishes joint states from a thread until it is stopped; what it does wrong are its attributes."""

    def __init__(self, node: Node, gripper_type: str = "GripperCommand") -> None:
        self.robot: Robot = read_robot(ROBOT)
        self.q = self.robot.home.copy()
        self.finger = 0.0
        self.quiet = False
        """Joint states stop."""
        self.behind = 0.0
        """Seconds by which their stamps are old."""
        self.without_finger = False
        self.metres = False
        """The finger's position is told as metres between the fingers."""
        self.split = False
        """Its joints come in two messages."""
        self.torques: list[float] = []
        """Efforts of the arm's joints."""
        self.held_up: float | None = None
        """Seconds into a motion after which the arm does not follow it."""
        self.abort: tuple[float, int, str] | None = None
        """Seconds into a motion, error code and text."""
        self.object = 0.8
        """Position of the finger joint at which something is between the fingers."""
        self._node = node
        self._states = node.publisher(WHERE.joint_states, JOINTS)
        self.arm = Action(node, WHERE.trajectory, FOLLOW)
        self.gripper = Action(node, WHERE.gripper, f"control_msgs/action/{gripper_type}")
        self._parallel = gripper_type == "ParallelGripperCommand"
        self._began = 0.0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        followed = 0
        while not self._stopping.wait(_PERIOD):
            if len(self.arm.goals) > followed:
                followed, self._began = len(self.arm.goals), time.monotonic()
            if self.arm.busy:
                self._follow(time.monotonic() - self._began)
            if self.gripper.busy:
                self._grip()
            if not self.quiet:
                self._publish()

    def _follow(self, elapsed: float) -> None:
        points = self.arm.goals[-1].trajectory.points
        times = [one.time_from_start.sec + one.time_from_start.nanosec / 1e9 for one in points]
        if self.arm.canceling:
            self.arm.end(CANCELED)
        elif self.abort is not None and elapsed > self.abort[0]:
            self.arm.end(ABORTED, error_code=self.abort[1], error_string=self.abort[2])
        elif elapsed > times[-1] and self.held_up is None:
            self.q = np.array(points[-1].positions)
            self.arm.end(SUCCEEDED)
        elif self.held_up is None or elapsed < self.held_up:
            self.q = np.array(
                [np.interp(elapsed, times, [one.positions[k] for one in points]) for k in range(len(self.q))]
            )

    def _grip(self) -> None:
        told = self.gripper.goals[-1].command.position
        target = min(float(told[0] if self._parallel else told), self.object)
        step = _GRIPPER_SPEED * _PERIOD
        self.finger += float(np.clip(target - self.finger, -step, step))
        if self.gripper.canceling:
            self.gripper.end(CANCELED)
        elif abs(self.finger - target) < 1e-6:
            stalled = target == self.object
            state = {"state": {"position": [self.finger]}} if self._parallel else {"position": self.finger}
            # Whoever is not configured to allow stalling calls a grasp aborted.
            self.gripper.end(ABORTED if stalled else SUCCEEDED, stalled=stalled, reached_goal=not stalled, **state)

    def _publish(self) -> None:
        sec, nanosec = divmod(time.time_ns() - int(self.behind * 1e9), 10**9)
        names, q = list(self.robot.joints), self.q.tolist()
        if not self.without_finger:
            finger = self.robot.gripper.width(self.finger) if self.metres else self.finger
            names, q = [*names, self.robot.gripper.fingers[0]], [*q, finger]
        stamp = {"sec": sec, "nanosec": nanosec}
        efforts = [*self.torques, *[0.0] * (len(names) - len(self.torques))] if self.torques else []
        for part in (slice(3), slice(3, None)) if self.split else (slice(None),):
            told = {"name": names[part], "position": q[part], "effort": efforts[part]}
            self._states.put(self._node.types.new(JOINTS, header={"stamp": stamp}, **told))
