"""Worlds of every suite: what the suite says of them, that they stand, and that the seed alone decides."""

from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace

from runner.contract import Refused
from runner.testing import run_stage
from stages.devices.servo import PIECE
from stages.devices.simulated_camera import SimulatedCamera
from stages.devices.simulation import Simulation
from stages.devices.suites import kinds
from stages.devices.suites.draft import Draft, shapes
from stages.devices.suites.reach import stuck
from stages.devices.tabletop import HIDDEN, least_shown
from stages.geometry.poses import inverse
from stages.messages import Arrangement, LookRequest, RobotCommand, RobotState, Snapshot
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.relations import Tolerances, supports
from stages.scene.stance import Standing
from stages.world import World
from tests.stages.planning.scenes import ROBOT, TABLE, catalogue

CATALOGUE = Catalogue.shared(BUILT_IN)


@cache
def looks(suite: str, seed: int) -> tuple[Snapshot, Snapshot, str]:
    """The goal and the start scene of a world, and what it said of them."""
    said: list[str] = []
    given = [message for kind in ("goal", "start") for message in (Arrangement(kind=kind), LookRequest(purpose=kind))]
    world = World(World.Config(suite=suite, seed=seed))
    found = run_stage(world, given, log=lambda text, _: said.append(text))
    return found[1], found[3], "\n".join(said)


def carried(snapshot: Snapshot) -> dict[str, str]:
    """What carries each object in truth."""
    shapes_of = shapes(CATALOGUE)
    down = np.eye(4)
    assert snapshot.T_base_table is not None
    down[2, 3] = -snapshot.T_base_table[2, 3]
    standing = [
        Standing.at(name, shapes_of[name.rstrip("_23")], down @ T)
        for name, T in zip(snapshot.names, snapshot.T_base_objects, strict=True)
    ]
    return {name: support.parent for name, support in supports(standing, Tolerances()).items()}


def poses(snapshot: Snapshot) -> dict[str, np.ndarray]:
    return dict(zip(snapshot.names, snapshot.T_base_objects, strict=True))


def test_equal_seeds_give_equal_worlds() -> None:
    first, again = looks("wild", 0), looks.__wrapped__("wild", 0)
    for one, other in zip(first[:2], again[:2], strict=True):
        assert one.names == other.names
        np.testing.assert_array_equal(one.T_base_objects, other.T_base_objects)


def test_wild_strangers_come_with_the_start() -> None:
    goal, start, said = looks("wild", 0)
    assert set(goal.names) < set(start.names)
    assert "draws rejected: no room in sight" in said
    assert (goal.T_base_objects[:, 2, 3] > TABLE.height - 0.001).all()


def test_swapped_towers_stand_the_other_way_round() -> None:
    goal, start, _ = looks("swap", 2)
    above, below = carried(goal), carried(start)
    tower = [(upper, lower) for upper, lower in above.items() if lower != "table"]
    assert len(tower) == 2
    assert all(below[lower] == upper for upper, lower in tower)


@pytest.mark.slow
def test_a_tray_whose_objects_hide_each_other_is_filled_in_another_order() -> None:
    goal, start, said = looks("swap", 391)
    assert set(goal.names) == set(start.names) and len(goal.names) == 9
    assert "91 of 92 draws rejected" in said


def test_twins_are_equal_objects_with_names_of_their_own() -> None:
    goal, start, _ = looks("twins", 2)
    assert {"water_bottle", "water_bottle_2", "water_bottle_3"} <= set(goal.names) == set(start.names)


def test_biased_cameras_see_something_else_than_they_say() -> None:
    goal, start, _ = looks("biased", 0)
    assert goal.errors is not None and start.errors is not None and goal.table_size is not None
    assert 0.01 <= abs(goal.errors.depth - 1) <= 0.02
    assert (goal.errors.gains != start.errors.gains).all() and (goal.errors.joints == start.errors.joints).all()
    assert goal.T_base_table is not None and abs(goal.T_base_table[2, 3] - TABLE.height) > 0.001
    camera = SimulatedCamera(CATALOGUE, ROBOT)
    T_base_camera = ROBOT.camera_pose(goal.joint_names, goal.joint_positions)
    _, depth = camera.image(goal, T_base_camera)
    camera.close()
    behind = T_base_camera[2, 3] - goal.T_base_table[2, 3]
    said = behind / -T_base_camera[2, 2]
    # In the middle of the image there is the table, or something on it.
    assert depth.shape == (480, 640) and not np.isclose(depth[240, 320], said, atol=0.003)


def test_no_robot_is_calibrated_but_only_biased_ones_have_joints_that_are_off() -> None:
    worlds = [World(World.Config(suite=suite, seed=0)) for suite in ("tray", "biased")]
    shots = [run_stage(world, [Arrangement(kind="goal"), LookRequest(purpose="goal")])[1] for world in worlds]
    assert all(abs(shot.errors.depth - 1) >= 0.01 and shot.errors.T_believed_true[0, 3] != 0 for shot in shots)
    assert [bool(shot.errors.joints.any()) for shot in shots] == [False, True]


def test_biased_joints_go_where_they_are_told_by_their_encoders() -> None:
    world = World(World.Config(suite="biased", seed=0))
    read = RobotCommand(times=np.zeros(0), positions=np.zeros((0, 8)), velocities=np.zeros((0, 8)))
    states = [found for found in run_stage(world, [Arrangement(kind="goal"), read]) if isinstance(found, RobotState)]
    off = states[-1].positions - [*ROBOT.posture.values(), *states[-1].positions[-2:]]
    assert 0.0005 < np.abs(off[1:8]).max() < np.deg2rad(0.3) + 0.001


def test_hidden_objects_are_in_the_goal_and_behind_others_at_the_start() -> None:
    goal, start, _ = looks("hidden", 0)
    assert set(goal.names) == set(start.names)
    camera = SimulatedCamera(CATALOGUE, ROBOT)
    T_base_camera = ROBOT.camera_pose(start.joint_names, start.joint_positions)

    def least_seen(shown: Snapshot) -> float:
        """Smallest share of an object's pixels that no other one hides."""
        alone = [replace(shown, names=(name,), T_base_objects=T[None]) for name, T in poses(shown).items()]
        bare = camera.image(replace(shown, names=(), T_base_objects=np.zeros((0, 4, 4))), T_base_camera)[1]
        whole = camera.image(shown, T_base_camera)[1]
        depths = [camera.image(one, T_base_camera)[1] for one in alone]
        return min(float((np.abs(whole - d) < 1e-4)[d < bare - 1e-4].mean()) for d in depths)

    assert least_seen(start) < min(0.3, least_seen(goal))
    camera.close()


def test_fallen_objects_lie_at_the_start_only() -> None:
    goal, start, _ = looks("fallen", 0)
    assert (goal.T_base_objects[:, 2, 2] > 0.99).all()
    assert (start.T_base_objects[:, 2, 2] < 0.1).any()


def test_of_every_object_of_a_goal_something_is_in_sight() -> None:
    """Of the can under the sponge of the first draw 1.5 % shows."""
    goal, _, said = looks("swap", 521)
    assert "of an object next to nothing is in sight 1" in said
    seen = [(CATALOGUE[name], T) for name, T in poses(goal).items()]
    assert least_shown(ROBOT, seen) > 0.05
    away, over = np.eye(4), np.eye(4)
    away[:3, 3], over[:3, 3] = (0.75, -0.2, 0.8), (0.75, 0.2, 0.8)
    below = over.copy()
    below[2, 3] -= 0.06
    alone = [(CATALOGUE["tuna_can"], away), (CATALOGUE["cereal_box"], over)]
    assert least_shown(ROBOT, alone) == 1.0
    assert least_shown(ROBOT, [*alone, (CATALOGUE["sponge"], below)]) < 0.5


def test_what_stands_where_no_hand_fits_is_stuck() -> None:
    draft = Draft(catalogue(), shapes(catalogue()), np.random.default_rng(0), robot=ROBOT, table=TABLE, hidden=HIDDEN)
    assert draft.put_at("mug", "table", np.array([0.6, 0.0]), 0.0)
    assert draft.put_at("soup_can", "table", np.array([0.6, -0.2]), 0.0)
    assert stuck(ROBOT, draft.placed, draft.supports, TABLE) == set()
    assert draft.put_at("salt_shaker", "mug", draft.placed["mug"].floor.mean(0), 0.0)
    assert stuck(ROBOT, draft.placed, draft.supports, TABLE) == {"mug", "salt_shaker"}


def with_tray(x: float, y: float) -> Draft:
    made = Draft(catalogue(), shapes(catalogue()), np.random.default_rng(0), robot=ROBOT, table=TABLE, hidden=1.0)
    assert made.put_at("tray", "table", np.array([x, y]), np.pi / 2)
    return made


def test_what_belongs_beside_the_tray_needs_room_there() -> None:
    goal = with_tray(0.7, 0.0)
    depth = np.ptp(goal.placed["tray"].outline[:, 0])
    assert goal.put_at("salt_shaker", "table", np.array([0.7 - depth / 2 - 0.04, 0.0]), 0.0)
    there = next(goal.moved_with(with_tray(0.7, 0.1)))
    assert there.placed.keys() == {"tray", "salt_shaker"}
    assert not stuck(ROBOT, there.placed, there.supports, TABLE)
    at_the_edge = with_tray(TABLE.center[0] - TABLE.size[0] / 2 + depth / 2 + 0.03, 0.0)
    assert all(stuck(ROBOT, one.placed, one.supports, TABLE) for one in goal.moved_with(at_the_edge))


def test_what_belongs_beside_the_tray_is_in_sight_there() -> None:
    """The near corners of the table are not in the camera's image: what belongs there could not be seen to stand."""
    goal = with_tray(0.7, 0.0)
    assert goal.put_at("salt_shaker", "table", np.array([0.52, -0.15]), 0.0)
    assert goal.put_at("soup_can", "table", np.array([0.51, 0.1]), 0.0)
    assert any(there.placed for there in goal.moved_with(with_tray(0.7, 0.05)))
    assert not any(there.placed for there in goal.moved_with(with_tray(0.7, -0.3)))


@pytest.mark.parametrize("seed", [443, 452, 577, pytest.param(722, marks=pytest.mark.slow)])
def test_a_full_tray_is_drawn_until_all_is_in_sight(seed: int) -> None:
    """It takes hundreds of draws, or only succeeds where objects go farther than to the next place, or anywhere."""
    goal, start, _ = looks("swap", seed)
    assert sorted(goal.names) == sorted(start.names)
    where = [dict(zip(each.names, each.T_base_objects, strict=True)) for each in (goal, start)]
    beside = [{name: (inverse(one["tray"]) @ T)[:2, 3] for name, T in one.items()} for one in where]
    moved = [name for name in beside[0] if np.linalg.norm(beside[0][name] - beside[1][name]) > 0.1]
    assert len(moved) >= 6


def test_unknown_suites_and_goals_are_refused_with_the_choices() -> None:
    with pytest.raises(Refused, match=r"world\.suite: no suite 'neat'; choose one of tray, wild, swap"):
        World.Config(suite="neat")
    with pytest.raises(Refused, match=r"world\.goal: suite wild draws its goals"):
        World.Config(suite="wild", goal="tea")
    with pytest.raises(Refused, match=r"world\.strangers: 6 is not one of 0 to 5"):
        World.Config(strangers=6)
    assert set(kinds.DRAWN) == set(kinds.NAMES) - {"tray"}


def meddled(suite: str, seed: int, *, pieces: int) -> tuple[str, Simulation]:
    """What happens in a world while the arm stands at home, and the world after it."""
    world, said = World(World.Config(suite=suite, seed=seed)), list[str]()
    still = RobotCommand(
        joint_names=("head_pan_joint",), times=np.array([0.0, pieces * PIECE]), positions=np.zeros((2, 1)),
        velocities=np.zeros((2, 1)),
    )  # fmt: skip
    run_stage(world, [Arrangement(kind="start"), still], log=lambda text, _: said.append(text))
    return "\n".join(said), world._simulation  # pyright: ignore[reportPrivateUsage]


def test_the_world_goes_on_while_the_robot_looks() -> None:
    """What falls while it looks has fallen at the next look."""
    world = World(World.Config(suite="tray", seed=0))
    run_stage(world, [Arrangement(kind="start")])
    simulation = world._simulation  # pyright: ignore[reportPrivateUsage]
    name = next(one for one in simulation.present if one != "tray")
    high = simulation.layout()[name].copy()
    high[2, 3] += 0.1
    simulation.add(name, high)
    (after,) = run_stage(world, [LookRequest(purpose="test")])
    assert isinstance(after, Snapshot)
    assert after.T_base_objects[after.names.index(name)][2, 3] < high[2, 3] - 0.05


def test_somebody_brings_moves_and_returns_objects_while_the_robot_works() -> None:
    said, simulation = meddled("disturbed", 1, pieces=1600)
    assert "somebody" in said.split("laid out")[1]
    assert set(simulation.present) >= set(said.split("laid out: ")[1].split(";")[0].split("\n")[0].split(", "))
    assert (simulation.object_poses()[:, 2, 2] > 0.99).all()


def test_slippery_objects_are_not_as_the_catalogue_has_them_and_fall_from_the_hand() -> None:
    world = kinds.suite("slippery", CATALOGUE, ROBOT, 0)
    factors = [value for one in world.factors.values() for value in (one.mass, one.friction)]
    assert min(factors) >= 0.5 and max(factors) <= 1.5 and np.ptp(factors) > 0.3

    class Hand(Simulation):
        """Holds a cup all the time."""

        def __init__(self) -> None:
            self.pads: list[float] = []

        def held(self) -> str:
            return "" if self.pads else "cup"

        def slide(self, factor: float) -> None:
            self.pads.append(factor)

    hands = [Hand() for _ in range(20)]
    said = [{world.meddle(hand, PIECE) for _ in range(60)} for hand in hands]
    assert {"cup falls from the hand"} < set.union(*said)
    assert sum(hand.pads == [0.01, 1.0] for hand in hands) == 3


def test_a_suite_says_what_a_catalogue_lacks() -> None:
    few = {label: item for label, item in CATALOGUE.objects.items() if label in ("tray", "plate", "cup")}
    assert set(kinds.suite("wild", Catalogue(few), ROBOT, 0).names) <= few.keys()
    with pytest.raises(Refused, match=r"world\.catalogue: suite hidden needs cereal_box, .* as well; valid: a copy of"):
        kinds.suite("hidden", Catalogue(few), ROBOT, 0)
    del few["cup"]
    with pytest.raises(Refused, match="suite wild needs anything with grasps as well"):
        kinds.suite("wild", Catalogue(few), ROBOT, 0)
    del few["plate"]
    with pytest.raises(Refused, match="suite tray needs tea_box, soup_can, cup, sugar_box, water_bottle as well"):
        kinds.suite("tray", Catalogue(few), ROBOT, 0)
