"""Postures of the arm that the camera sees, and the way to them: for looks at the robot itself."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import replace

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.camera import project
from stages.geometry.poses import pose, random_rotations
from stages.messages import Arrived, Outcome, PostureRequest, RobotCommand, RobotState
from stages.messages.robot import Guard
from stages.planning.motion.collision import AMPLE, CollisionWorld
from stages.planning.motion.motion import (
    arm,
    free_motion,
    onward,
    restarts,
    robot_command,
    solve_ik,
    way_back,
    way_out,
)
from stages.robots import BESIDE, Robot
from stages.scene.catalogue import Primitive

_ABOVE = (0.10, 0.50)
"""Metres above the table between which the fingertips are."""
_UPWARDS = 0.3
"""Sine of the elevation beyond which the hand does not point."""
_NEAREST = 0.45
"""Metres from the camera within which the hand is not."""
_BORDER = 60
"""Pixels from the edge of the image within which the fingertips are not."""
_DRAWS = 60
"""Places of the hand that are tried for each posture."""
_CLEARANCE = 0.002
"""Metres that motions keep from everything; postures keep more, so that the arm that is a little off can leave them."""
_AROUND = 0.03
"""Metres by which the table may reach further than it is declared, to the front, to the back and down."""
_BUMP = 7.0
"""Newtons at the hand that are a touch."""

Motion = Generator[RobotCommand, RobotState, Arrived]
Homecoming = Generator[RobotCommand, RobotState, Outcome]


def world_of(robot: Robot, request: PostureRequest, *, clearance: float = AMPLE) -> CollisionWorld:
    """The robot, the table at its height, and what is occupied."""
    declared = robot.table
    width, depth = declared.size
    table = replace(
        declared,
        height=request.table_height,
        size=(width + 2 * _AROUND, depth + 2 * BESIDE),
        thickness=declared.thickness + 2 * _AROUND,
    )
    boxes = tuple(
        Primitive("box", tuple((high - low).tolist()), pose(np.eye(3), (low + high) / 2))
        for low, high in zip(request.occupied[:, :3], request.occupied[:, 3:], strict=True)
    )
    return CollisionWorld(robot, table, {}, occupied=boxes, clearance=clearance)


def postures_in_view(world: CollisionWorld, rng: np.random.Generator, count: int) -> Iterator[Floats]:
    """At most ``count`` postures (J) with the hand over the table, in sight, free of everything; all ways turned."""
    robot = world.robot
    height = robot.table.height
    found = 0
    for R in random_rotations(_DRAWS * count, rng):
        place = rng.uniform([robot.x[0], robot.y[0], height + _ABOVE[0]], [robot.x[1], robot.y[1], height + _ABOVE[1]])
        if R[2, 0] > _UPWARDS or not _in_sight(robot, place):
            continue
        q = solve_ik(world, pose(R, place), seeds=restarts(world, rng, robot.home, extra=1))
        if q is not None:
            yield q
            found += 1
        if found == count:
            return


def _in_sight(robot: Robot, place: Floats) -> bool:
    point = robot.T_camera_base[:3, :3] @ place + robot.T_camera_base[:3, 3]
    if point[2] < _NEAREST:
        return False
    size = np.array(robot.camera.size)
    pixel = project(point, robot.camera.K)
    return bool((pixel > _BORDER).all() and (pixel < size - _BORDER).all())


class PostureRoutine:
    """One motion into a posture as a generator of commands, from wherever the arm stands."""

    in_hand = ""
    """What the hand holds: nothing."""

    def __init__(
        self, request: PostureRequest, *, robot: Robot, rng: np.random.Generator, log: Callable[[str], None]
    ) -> None:
        self._request, self._robot, self._rng, self._log = request, robot, rng, log
        self._world = world_of(robot, request, clearance=_CLEARANCE)

    def run(self) -> Motion:
        """Commands to execute one after the other; each is answered by the encoders after it."""
        state = yield robot_command(self._robot, "read the encoders")
        started = state.time
        goal = self._request.positions
        path, reason = None, state.reason
        if not state.stopped:
            close = self._world.contacts(arm(self._robot, state)) | self._world.contacts(goal)
            reason = f"no free motion; too close: {close or 'nothing'}"
            path = free_motion(self._world, arm(self._robot, state), goal, self._rng)
        if path is not None:
            label = self._request.label
            state = yield robot_command(self._robot, label, path, guard=Guard(force=_BUMP))
            reason = f"{state.reason} on the way to {label}" if state.stopped or state.shown else ""
        if reason:
            self._log(f"{self._request.label}: {reason}")
        stopped = state.stopped
        if path is not None and stopped == "touch":
            state = yield way_back(self._robot, path, state)
        return Arrived(
            success=not reason,
            reason=reason,
            stopped=state.stopped or stopped,
            joint_names=state.joint_names,
            positions=state.positions,
            robot_seconds=state.time - started,
        )

    def recover(self) -> Homecoming:
        """Commands that bring the arm home from where it was stopped."""
        state = yield robot_command(self._robot, "read the encoders")
        started = state.time
        path = None
        if not state.stopped:
            q = arm(self._robot, state)
            path = free_motion(self._world, q, self._robot.home, self._rng)
            if path is None:
                path = onward(self._world, way_out(self._world, q, self._rng), self._robot.home, self._rng)
        if path is not None:
            state = yield robot_command(self._robot, "go home", path, guard=Guard(force=_BUMP))
        arrived = path is not None and not state.stopped and not state.shown
        return Outcome(
            number=0,
            object="",
            destination="",
            success=arrived,
            failed_stage="" if arrived else state.stopped or "touch",
            reason="no free motion home" if path is None and not state.stopped else state.reason,
            grasp="",
            attempts=0,
            robot_seconds=state.time - started,
            planning_seconds=0.0,
        )
