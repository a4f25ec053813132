"""Collision-free motion: inverse kinematics, straight hand motions, RRT-Connect and time parameterisation."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Any, cast

import mujoco
import numpy as np
import ompl.base as ob
import ompl.geometric as og
import ompl.util as ou

from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages import RobotCommand, RobotState
from stages.messages.robot import Guard
from stages.planning.motion.collision import CollisionWorld, quaternion
from stages.robots import Robot

_LARGEST_JUMP = 0.35
"""Radians between waypoints of a straight hand motion; more means a change of configuration."""
_STRAIGHT_STEP = 0.01
"""Metres between waypoints of a straight hand motion."""
FAST, SLOW = 0.85, 0.5
"""Share of the joint limits for free motions, and for those next to objects."""
RUB = 15.0
"""Newtons that do not matter where the hand leaves what it touches."""
_RESOLUTION = 0.02
"""Largest joint motion between collision checks of a path, radians (metres)."""
_CHECKS = 15_000
"""Collision checks after which RRT-Connect gives up."""
_REACHES, _DRAWS = (0.02, 0.05, 0.1, 0.2, 0.4), 50
"""How far a way out is looked for, standard deviations of each joint in radians (metres), and how often at each."""
_NO_DEEPER = 5e-4
"""Metres by which a way out may come closer to what is too close already."""
_SPLINE_STEP = 0.01
"""Waypoints are densified to this joint distance, radians (metres), so that the spline stays on the edges, which are
what was checked: at corners the hand leaves them by 1 mm at most, with five times the distance by 6 mm."""
_SAMPLE_TIME = 0.02

ou.noOutputHandler()


def _without_plots(module: str) -> Any:
    """Imports what would load matplotlib, which nobody here plots with and which takes a third of a second."""
    absent = [name for name in ("matplotlib", "matplotlib.pyplot") if name not in sys.modules]
    sys.modules.update({name: ModuleType(name) for name in absent})
    try:
        return importlib.import_module(module)
    finally:
        for name in absent:
            del sys.modules[name]


toppra = _without_plots("toppra")
toppra.setup_logging("ERROR")


@dataclass(frozen=True)
class Trajectory:
    """A timed joint motion: ``times`` (T) in seconds from 0, ``positions`` and ``velocities`` (T x J)."""

    times: Floats
    positions: Floats
    velocities: Floats


def warm_up(robot: Robot) -> None:
    """Loads the kernels of inverse kinematics, so that the first motion does not wait for them."""
    world = CollisionWorld(robot, robot.table, {})
    solve_ik(world, world.hand(robot.home), seeds=iter([robot.home]))


def solve_ik(
    world: CollisionWorld, T_base_hand: Floats, *, seeds: Iterator[Floats], free: bool = True, iterations: int = 60
) -> Floats | None:
    """Joint positions (J) that put the hand at ``T_base_hand``, from the first seed that leads there.

    With ``free``, solutions must be collision-free.
    """
    for seed in seeds:
        q = world.chain.posture(T_base_hand, seed, iterations)
        if q is not None and (not free or world.is_free(q)):
            return q
    return None


def restarts(world: CollisionWorld, rng: np.random.Generator, *first: Floats, extra: int) -> Iterator[Floats]:
    """Seeds for :func:`solve_ik`: ``first``, then ``extra`` random postures within the joint limits."""
    yield from first
    for _ in range(extra):
        yield rng.uniform(world.lower, world.upper)


def straight_motion(world: CollisionWorld, start: Floats, T_base_hand: Floats, *, free: bool = True) -> Floats | None:
    """Waypoints (W x J) that move the hand on a straight line from joint positions ``start`` to ``T_base_hand``.

    None where the line leaves the joint limits, jumps between configurations or, with ``free``, collides.
    """
    waypoints = [start]
    for T in _interpolate(world.hand(start), T_base_hand):
        q = solve_ik(world, T, seeds=iter(waypoints[-1:]), free=free)
        if q is None or np.abs(q - waypoints[-1]).max() > _LARGEST_JUMP:
            return None
        waypoints.append(q)
    return np.array(waypoints)


def free_motion(world: CollisionWorld, start: Floats, goal: Floats, rng: np.random.Generator) -> Floats | None:
    """Waypoints (W x J) of a collision-free motion in joint space, with ample clearance where there is room for it.

    None where none is found. The edges between waypoints are checked every ``_RESOLUTION``. Equal generators give
    equal motions.
    """
    with world.ample():
        path = _connect(world, start, goal, rng)
    return _connect(world, start, goal, rng) if path is None else path


def onward(world: CollisionWorld, way: Floats | None, goal: Floats, rng: np.random.Generator) -> Floats | None:
    """A way (W x J) and the free motion from its end to ``goal`` (J); None where either is missing."""
    rest = None if way is None else free_motion(world, way[-1], goal, rng)
    return None if way is None or rest is None else np.vstack([way, rest])


def way_out(world: CollisionWorld, start: Floats, rng: np.random.Generator) -> Floats | None:
    """Waypoints (2 x J) from a posture that is too close to something to one near it that is not, no closer on the way.

    None where none is found.
    """
    limit = world.depth(start) + _NO_DEEPER
    for reach in _REACHES:
        for change in reach * rng.normal(size=(_DRAWS, len(start))):
            way = np.array([start, np.clip(start + change, world.lower, world.upper)])
            if world.is_free(way[-1]) and all(world.depth(q) <= limit for q in densify(way, _RESOLUTION)):
                return way
    return None


def _connect(world: CollisionWorld, start: Floats, goal: Floats, rng: np.random.Generator) -> Floats | None:
    """RRT-Connect (Kuffner 2000), then shortcuts."""
    ou.RNG.setSeed(int(rng.integers(1, 2**31)))
    if not (world.is_free(start) and world.is_free(goal)):
        return None
    setup = _simple_setup(world, start, goal)
    budget = world.checks + _CHECKS
    setup.solve(ob.PlannerTerminationCondition(lambda: world.checks > budget))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    simplifier = og.PathSimplifier(setup.getSpaceInformation())
    simplifier.reduceVertices(path, 30, 30)
    simplifier.partialShortcutPath(path, 60, 40)
    simplifier.reduceVertices(path, 30, 30)
    return np.array([_array(path.getState(k), len(start)) for k in range(path.getStateCount())])


def is_motion_free(world: CollisionWorld, waypoints: Floats, *, step: float = 0.01) -> bool:
    """Checks the straight edges between ``waypoints`` (W x J) every ``step`` radians."""
    return all(world.is_free(q) for q in densify(waypoints, step))


def densify(waypoints: Floats, step: float = 0.05) -> Floats:
    """Inserts points so that no joint moves more than ``step`` to the next, radians (metres); drops repeated points."""
    dense = [waypoints[0]]
    for a, b in pairwise(waypoints):
        distance = np.abs(b - a).max()
        if distance > 1e-6:
            pieces = int(np.ceil(distance / step))
            dense += [a + (b - a) * i / pieces for i in range(1, pieces + 1)]
    return np.array(dense)


def back_along(way: Floats, q: Floats) -> tuple[float, Floats]:
    """How far joint positions (J) are from a way (W x J), radians, and the way back along it, from them on."""
    distances = np.abs(way - q).max(1)
    return float(distances.min()), np.vstack([q, way[: distances.argmin()][::-1]])


def robot_command(
    robot: Robot,
    label: str,
    waypoints: Floats | None = None,
    *,
    speed: float = FAST,
    width: float | None = None,
    guard: Guard | None = None,
) -> RobotCommand:
    """A trajectory through ``waypoints`` (W x J), then a gripper width; either may be absent."""
    if waypoints is None:
        none = np.zeros((0, len(robot.joints)))
        return RobotCommand(times=np.zeros(0), positions=none, velocities=none, gripper_width=width, label=label)
    motion = time_parameterise(robot, waypoints, speed=speed)
    return RobotCommand(
        joint_names=robot.joints,
        times=motion.times,
        positions=motion.positions,
        velocities=motion.velocities,
        gripper_width=width,
        label=label,
        guard=guard,
    )


def way_back(robot: Robot, waypoints: Floats, state: RobotState) -> RobotCommand:
    """Has the empty hand go back the way (W x J) on which it was stopped, which was free."""
    _, back = back_along(densify(waypoints), arm(robot, state))
    return robot_command(robot, "go back the way it came", back, speed=SLOW, guard=Guard(force=RUB))


def arm(robot: Robot, state: RobotState) -> Floats:
    """Positions (J) of the joints that planning moves."""
    where = dict(zip(state.joint_names, state.positions, strict=True))
    return np.array([where[name] for name in robot.joints])


def time_parameterise(robot: Robot, waypoints: Floats, *, speed: float = FAST) -> Trajectory:
    """Fastest traversal of ``waypoints`` (W x J) within ``speed`` times the joint limits (TOPP-RA, Pham 2018)."""
    points = densify(waypoints, _SPLINE_STEP)
    if len(points) < 2:
        return Trajectory(np.zeros(1), points, np.zeros_like(points))
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    # A clamped spline stands still at its ends, where the time optimal motion would then creep.
    path = toppra.SplineInterpolator(arc, points, bc_type="natural")
    velocity, acceleration = robot.velocity * speed, robot.acceleration * speed
    limits = [
        toppra.constraint.JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        toppra.constraint.JointAccelerationConstraint(np.stack([-acceleration, acceleration], axis=1)),
    ]
    grid = np.linspace(0, arc[-1], max(60, 4 * len(points)))
    method = toppra.algorithm.TOPPRA(limits, path, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    timed = method.compute_trajectory(0, 0)
    times = np.append(np.arange(0, timed.duration, _SAMPLE_TIME), timed.duration)
    return Trajectory(times, timed(times), timed(times, 1))


def _pose_error(current: Floats, target: Floats) -> Floats:
    """Twist (6) in the base frame that leads from ``current`` to ``target`` in unit time."""
    rotation = np.zeros(3)
    mujoco.mju_quat2Vel(rotation, quaternion(target[:3, :3] @ current[:3, :3].T), 1.0)
    return np.concatenate([target[:3, 3] - current[:3, 3], rotation])


def _interpolate(start: Floats, end: Floats) -> Iterator[Floats]:
    """Poses after ``start`` up to ``end``: straight line, rotation about one axis."""
    twist = _pose_error(start, end)
    steps = max(2, int(np.ceil(np.linalg.norm(twist[:3]) / _STRAIGHT_STEP)))
    for k in range(1, steps + 1):
        turn, R = np.array([1.0, 0, 0, 0]), np.zeros(9)
        mujoco.mju_quatIntegrate(turn, np.ascontiguousarray(twist[3:]), k / steps)
        mujoco.mju_quat2Mat(R, turn)
        yield pose(R.reshape(3, 3) @ start[:3, :3], start[:3, 3] + twist[:3] * k / steps)


def _simple_setup(world: CollisionWorld, start: Floats, goal: Floats) -> Any:
    joints = len(start)
    space = ob.RealVectorStateSpace(joints)
    bounds = ob.RealVectorBounds(joints)
    # Encoders may read a little beyond a joint's limit: from there, too, there is a way.
    for i, (low, high) in enumerate(zip(np.minimum(world.lower, start), np.maximum(world.upper, start), strict=True)):
        bounds.setLow(i, float(low) - 1e-6)
        bounds.setHigh(i, float(high) + 1e-6)
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    information = setup.getSpaceInformation()
    setup.setStateValidityChecker(lambda state: world.is_free(_array(state, joints)))
    information.setStateValidityCheckingResolution(_RESOLUTION / space.getMaximumExtent())
    setup.setStartAndGoalStates(_state(information, start), _state(information, goal))
    planner = og.RRTConnect(information)
    planner.setRange(1.0)
    setup.setPlanner(planner)
    return setup


def _state(information: Any, q: Floats) -> Any:
    state = information.allocState()
    for i, value in enumerate(q):
        state[i] = float(value)
    return state


def _array(state: Any, joints: int) -> Floats:
    return np.array([cast(float, state[i]) for i in range(joints)])
