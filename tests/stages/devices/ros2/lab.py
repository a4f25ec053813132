"""A lab on loopback: a Zenoh router and nodes around it."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import zenoh

from stages.devices.ros2.node import Node
from stages.devices.ros2.services import Request, serve
from stages.devices.ros2.settings import Link
from stages.devices.ros2.wire import LATCHED

TRAJECTORY = "control_msgs/action/FollowJointTrajectory"
PATIENCE = 30.0
"""Seconds for what a machine with nothing else to do needs a tenth of a second for."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def open_router(port: int, protocol: str = "tcp", **more: Any) -> zenoh.Session:
    """A router as rmw_zenohd is one."""
    config = zenoh.Config()
    settings: dict[str, Any] = {
        **more,
        "mode": "router",
        "listen/endpoints": [f"{protocol}/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextlib.contextmanager
def router() -> Iterator[str]:
    """A router while the block runs; gives its endpoint."""
    port = free_port()
    session = open_router(port)
    try:
        yield f"tcp/127.0.0.1:{port}"
    finally:
        session.close()


@contextlib.contextmanager
def node(endpoint: str, name: str, said: list[str] | None = None, **settings: Any) -> Iterator[Node]:
    """A node at a router; ``said`` takes its warnings."""
    warnings = [] if said is None else said
    one = Node(Link(router=endpoint, node=name, **settings), warnings.append)
    try:
        yield one
    finally:
        one.close()
    if said is None:
        assert warnings == []


class ActionServer:
    """Follows trajectories of one joint, a point after the other, each with feedback; ``held`` goals wait."""

    def __init__(self, node: Node, name: str, *, accepts: bool = True, held: bool = False) -> None:
        self._node = node
        self._accepts = accepts
        self.go = threading.Event()
        if not held:
            self.go.set()
        self.canceled = threading.Event()
        self._goal: Any = None
        parts = f"{name}/_action"
        self.feedback = node.publisher(f"{parts}/feedback", f"{TRAJECTORY}_FeedbackMessage")
        self._status = node.publisher(f"{parts}/status", "action_msgs/msg/GoalStatusArray", LATCHED)
        serve(node, f"{parts}/send_goal", f"{TRAJECTORY}_SendGoal", self._on_goal)
        serve(node, f"{parts}/get_result", f"{TRAJECTORY}_GetResult", self._on_result)
        serve(node, f"{parts}/cancel_goal", "action_msgs/srv/CancelGoal", self._on_cancel)

    def _on_goal(self, request: Request) -> None:
        self._goal = request.message
        request.answer(self._node.types.new(f"{TRAJECTORY}_SendGoal_Response", accepted=self._accepts))

    def _on_result(self, request: Request) -> None:
        threading.Thread(target=self._execute, args=(request,), daemon=True).start()

    def _on_cancel(self, request: Request) -> None:
        self.canceled.set()
        self.go.set()
        request.answer(
            self._node.types.new("action_msgs/srv/CancelGoal_Response", goals_canceling=[request.message.goal_info])
        )

    def _execute(self, request: Request) -> None:
        new, goal = self._node.types.new, self._goal
        self.go.wait()
        for index, point in enumerate([] if self.canceled.is_set() else goal.goal.trajectory.points):
            actual = new("trajectory_msgs/msg/JointTrajectoryPoint", positions=np.array(point.positions))
            feedback = new(f"{TRAJECTORY}_Feedback", joint_names=["j1"], actual=actual)
            self.feedback.put(new(f"{TRAJECTORY}_FeedbackMessage", goal_id=goal.goal_id, feedback=feedback))
            self._status.put(new("action_msgs/msg/GoalStatusArray", status_list=[{"status": 2 + index}]))
        result = new(f"{TRAJECTORY}_Result", error_string="given up" if self.canceled.is_set() else "done")
        status = 5 if self.canceled.is_set() else 4
        request.answer(new(f"{TRAJECTORY}_GetResult_Response", status=status, result=result))
