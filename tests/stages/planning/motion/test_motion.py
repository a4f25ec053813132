import subprocess
import sys

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stages.geometry.poses import pose, raised
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.kinematics import POSITION_TOLERANCE, ROTATION_TOLERANCE
from stages.planning.motion.motion import (
    densify,
    free_motion,
    is_motion_free,
    restarts,
    solve_ik,
    straight_motion,
    time_parameterise,
    way_out,
)
from stages.robots import BUILT_IN, read_robot
from tests.stages.planning.scenes import ROBOT, catalogue, standing, world

HOME = ROBOT.home


@pytest.fixture(scope="module")
def scene() -> CollisionWorld:
    return world("cup", cup=standing("cup", 0.6, 0.0), cereal_box=standing("cereal_box", 0.6, 0.2, yaw=0.3))


def above_table(x: float, y: float) -> np.ndarray:
    down = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = down, [x, y, 0.95]
    return T


@settings(max_examples=25, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31))
def test_ik_finds_the_pose_that_fk_reports(scene: CollisionWorld, seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Away from the limits, where the way from a neighbour may be blocked.
    q = rng.uniform(0.9 * scene.lower + 0.1 * scene.upper, 0.1 * scene.lower + 0.9 * scene.upper)
    target = scene.hand(q)
    near = np.clip(q + rng.normal(scale=0.1, size=len(q)), scene.lower, scene.upper)
    found = solve_ik(scene, target, seeds=restarts(scene, rng, near, extra=20), free=False)
    assert found is not None
    assert np.abs(scene.hand(found)[:3, 3] - target[:3, 3]).max() < POSITION_TOLERANCE
    assert np.abs(scene.hand(found)[:3, :3] - target[:3, :3]).max() < 2 * ROTATION_TOLERANCE
    assert ((found >= scene.lower) & (found <= scene.upper)).all()


@pytest.mark.parametrize("name", ["fetch", "panda", "ur5e_hand"])
def test_the_hand_is_where_the_simulator_has_it(name: str) -> None:
    robot = read_robot(BUILT_IN.with_name(f"{name}.yaml"))
    cup = catalogue()["cup"], standing("cup", 0.6, 0.0)
    chain = CollisionWorld(robot, robot.table, {"cup": cup}, carried="cup").chain
    model = robot.specification(seen=False).compile()
    data = mujoco.MjData(model)
    for joint, position in robot.still.items():
        data.joint(joint).qpos[0] = position
    for seed in range(3):
        q = np.random.default_rng(seed).uniform(chain.lower, chain.upper)
        for joint, position in zip(robot.joints, q, strict=True):
            data.joint(joint).qpos[0] = position
        mujoco.mj_kinematics(model, data)
        link = data.body(robot.gripper.link)
        T_base_hand = pose(link.xmat.reshape(3, 3), link.xpos) @ robot.gripper.T_link_hand
        np.testing.assert_allclose(chain.hand(q), T_base_hand, atol=1e-9)


def test_ik_gives_up_out_of_reach(scene: CollisionWorld) -> None:
    assert solve_ik(scene, above_table(2.0, 0.0), seeds=iter([HOME])) is None


def test_straight_motion_stays_on_the_line(scene: CollisionWorld) -> None:
    start = solve_ik(scene, above_table(0.6, -0.2), seeds=restarts(scene, np.random.default_rng(0), HOME, extra=10))
    assert start is not None
    path = straight_motion(scene, start, raised(scene.hand(start), -0.08))
    assert path is not None
    positions = np.array([scene.hand(q)[:3, 3] for q in path])
    np.testing.assert_allclose(positions[:, :2], np.broadcast_to(positions[0, :2], (len(path), 2)), atol=2e-3)
    assert positions[-1, 2] == pytest.approx(positions[0, 2] - 0.08, abs=2e-3)


def test_straight_motion_refuses_to_hit_the_table(scene: CollisionWorld) -> None:
    start = solve_ik(scene, above_table(0.6, -0.2), seeds=restarts(scene, np.random.default_rng(0), HOME, extra=10))
    assert start is not None
    assert straight_motion(scene, start, raised(scene.hand(start), -0.3)) is None


def test_free_motion_is_collision_free_and_repeatable(scene: CollisionWorld) -> None:
    goal = solve_ik(scene, above_table(0.6, 0.35), seeds=restarts(scene, np.random.default_rng(1), HOME, extra=20))
    assert goal is not None
    first, second = (free_motion(scene, HOME, goal, np.random.default_rng(5)) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first, second)
    np.testing.assert_allclose(first[[0, -1]], [HOME, goal])
    assert is_motion_free(scene, first)
    timed = time_parameterise(scene.robot, first)
    assert all(scene.is_free(q) for q in timed.positions)


def test_an_arm_whose_encoders_read_beyond_a_limit_finds_a_way(scene: CollisionWorld) -> None:
    beyond = HOME.copy()
    beyond[0] = scene.lower[0] - 0.005
    assert free_motion(scene, beyond, HOME, np.random.default_rng(5)) is not None


def test_a_hand_that_touches_something_finds_a_way_out_though_it_cannot_rise() -> None:
    """Somebody put a carton against the hand, which cannot go straight up from there."""
    leaning = np.array([[-0.206, 0.965, -0.162], [-0.967, -0.226, -0.117], [-0.149, 0.132, 0.980]])
    scene = world("", cereal_box=pose(leaning, np.array([0.5397, -0.3127, 0.7845])))
    q = np.array([0.3847, -0.8036, -0.588, 0.307, 1.6126, 0.8445, 0.102, 0.4494])
    assert scene.contacts(q) == {("cereal_box", "gripper_link")}
    assert straight_motion(scene, q, raised(scene.hand(q), 0.03), free=False) is None
    way = way_out(scene, q, np.random.default_rng(0))
    assert way is not None
    assert max(scene.depth(between) for between in densify(way, 0.005)) < scene.depth(q) + 1e-3
    assert free_motion(scene, way[-1], HOME, np.random.default_rng(0)) is not None


@settings(max_examples=25, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31))
def test_a_way_out_ends_free_and_goes_no_deeper(scene: CollisionWorld, seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = rng.uniform(scene.lower, scene.upper)
    way = way_out(scene, q, rng)
    if way is not None:
        assert (scene.is_free(way[-1]), way[0].tolist()) == (True, q.tolist())
        assert max(scene.depth(between) for between in densify(way, 0.005)) < scene.depth(q) + 2e-3


def test_trajectories_respect_the_limits() -> None:
    waypoints = HOME + np.array([[0.0], [0.3], [-0.2], [0.4]]) * np.array([0.1, 1, 1, 1, 1, 1, 1, 1])
    waypoints[:, 0] = HOME[0] - np.abs(waypoints[:, 0] - HOME[0])
    motion = time_parameterise(ROBOT, waypoints, speed=0.5)
    assert (np.abs(motion.velocities) <= 0.5 * ROBOT.velocity * 1.02).all()
    np.testing.assert_allclose(motion.velocities[[0, -1]], 0, atol=1e-6)
    np.testing.assert_allclose(motion.positions[[0, -1]], waypoints[[0, -1]], atol=1e-6)
    assert (np.diff(motion.times) > 0).all()
    assert motion.times[-1] < 10


@settings(max_examples=25, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31))
def test_at_corners_the_hand_stays_on_the_way_that_was_checked(scene: CollisionWorld, seed: int) -> None:
    turns = np.random.default_rng(seed).normal(scale=0.25, size=(2, len(HOME)))
    waypoints = np.clip(HOME + np.vstack([np.zeros(len(HOME)), turns.cumsum(0)]), scene.lower, scene.upper)
    checked = np.array([scene.hand(q)[:3, 3] for q in densify(waypoints, 0.001)])
    followed = np.array([scene.hand(q)[:3, 3] for q in time_parameterise(ROBOT, waypoints).positions])
    assert max(np.linalg.norm(checked - one, axis=1).min() for one in followed) < 1.5e-3


def test_the_held_object_collides_too(scene: CollisionWorld) -> None:
    target = above_table(0.6, 0.2)
    target[2, 3] = 0.70 + 0.150 + 0.06
    q = solve_ik(scene, target, seeds=restarts(scene, np.random.default_rng(2), HOME, extra=20))
    assert q is not None
    below_hand = np.eye(4)
    below_hand[:3, :3] = np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]])
    below_hand[0, 3] = 0.05
    with scene.holding(below_hand, width=0.078):
        assert not scene.is_free(q)
        assert ("cereal_box", "held") in scene.contacts(q)
        with scene.resting("cereal_box"):
            assert scene.is_free(q)
    assert scene.is_free(q)


def test_planning_motions_loads_no_plots() -> None:
    program = "import sys, stages.planning.motion.motion; loaded = 'matplotlib' in sys.modules;"
    program += "import matplotlib.pyplot as plt; sys.exit(loaded or not plt.plot)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
