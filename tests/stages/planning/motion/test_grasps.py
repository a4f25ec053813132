import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.planning.motion.grasps import HandPose, distinct_grasps, hand_poses
from tests.stages.planning.scenes import TABLE, catalogue, standing

GRASPABLE = [name for name, entry in catalogue().objects.items() if entry.grasps]
RESTING = [(name, k) for name in GRASPABLE for k in range(len(catalogue()[name].resting))]


@pytest.mark.parametrize("name", GRASPABLE)
def test_hand_poses_are_the_grasp_up_to_a_symmetry(name: str) -> None:
    entry, T = catalogue()[name], standing(name, 0.6, 0.1, yaw=0.7)
    symmetries = entry.symmetries.transforms(np.deg2rad(22.5))
    poses = _all_hand_poses(name, T)
    assert poses
    for hand in poses:
        np.testing.assert_allclose(hand.T_base_hand, T @ hand.T_object_hand, atol=1e-9)
        used = hand.T_object_hand @ np.linalg.inv(hand.grasp.T_object_grasp)
        assert min(np.abs(used - S).max() for S in symmetries) < 1e-6
        assert hand.T_base_hand[2, 0] < 0.21


@pytest.mark.parametrize(("name", "resting"), RESTING)
def test_no_finger_gets_below_an_object_however_it_rests(name: str, resting: int) -> None:
    for hand in _all_hand_poses(name, standing(name, 0.6, 0.1, resting=resting)):
        for side in (-0.5, 0.5):
            finger = hand.T_base_hand @ [0, side * hand.grasp.width, 0, 1]
            assert finger[2] > TABLE.height - 1e-9


@pytest.mark.parametrize(("name", "resting"), [case for case in RESTING if case != ("cereal_box", 1)])
def test_some_fingers_close_from_the_sides_however_an_object_rests(name: str, resting: int) -> None:
    """Not from above and below, but the cereal box on its widest face is too wide for the hand."""
    poses = _all_hand_poses(name, standing(name, 0.6, 0.1, resting=resting))
    assert any(abs(hand.T_base_hand[2, 1]) < np.sin(np.pi / 4) for hand in poses)


@pytest.mark.parametrize("name", GRASPABLE)
def test_the_pregrasp_lies_behind_the_grasp(name: str) -> None:
    for hand in _all_hand_poses(name, standing(name, 0.6, 0.1)):
        back = np.linalg.inv(hand.T_base_hand) @ hand.T_base_prehand
        assert back[0, 3] < -0.05


def test_a_round_object_keeps_one_grasp_of_a_kind_and_turns_it() -> None:
    can = catalogue()["soup_can"]
    top = [grasp for grasp in distinct_grasps(can) if grasp.kind == "top"]
    assert [grasp.name for grasp in top] == ["top 0", "bottom"]
    assert len(hand_poses(can, top[0], standing("soup_can", 0.6, 0.0))) == 16


def test_side_grasps_away_from_the_robot_come_first() -> None:
    can = catalogue()["soup_can"]
    side = next(grasp for grasp in distinct_grasps(can) if grasp.kind == "side")
    approach = hand_poses(can, side, standing("soup_can", 0.6, 0.0))[0].T_base_hand[:3, 0]
    assert approach[0] > 0.99


def _all_hand_poses(name: str, T_base_object: Floats) -> list[HandPose]:
    entry = catalogue()[name]
    return [hand for grasp in distinct_grasps(entry) for hand in hand_poses(entry, grasp, T_base_object)]
