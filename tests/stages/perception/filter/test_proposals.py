"""Where particles come from: on the plane, on readings, and flipped as the object's own box says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.geometry.poses import compose, exp_so3, rotate, rotation_angle
from stages.perception.filter.proposals import Guess, Proposals, box_axes, distinct_best, round_body
from tests.stages.perception.scenes import CATALOGUE, camera

TABLE = camera()
READINGS = Guess(np.array([0.0, 0.0, 0.75]) + 0.02 * np.random.default_rng(0).normal(size=(50, 3)), TABLE)


def heights(poses: np.ndarray, label: str) -> np.ndarray:
    """Of the lowest vertex above the table, P."""
    points = rotate(poses[:, None, :, :3], CATALOGUE[label].simplified(500).vertices[None]) + poses[:, None, :, 3]
    return ((points - TABLE[:3, 3]) * TABLE[:3, 2]).sum(-1).min(1)


def test_upright_guesses_stand_on_the_table() -> None:
    for make in ("initial", "uniform"):
        poses = getattr(Proposals(CATALOGUE["mug"], 3), make)(READINGS, 40, np.random.default_rng(1))
        assert heights(poses, "mug") == pytest.approx(0, abs=1e-9)
        assert poses[:, :, 2] == pytest.approx(np.tile(TABLE[:3, 2], (40, 1)))


def test_some_guesses_rest_and_some_do_not() -> None:
    poses = Proposals(CATALOGUE["mug"], 6).initial(READINGS, 400, np.random.default_rng(1))
    assert 0.1 < (np.abs(heights(poses, "mug")) < 1e-9).mean() < 0.6


def test_diffusion_turns_about_the_centre_and_shifts() -> None:
    rng, label = np.random.default_rng(3), "mug"
    proposals, centre = Proposals(CATALOGUE[label], 6), CATALOGUE[label].bounds.mean(0)
    poses = np.concatenate([exp_so3(rng.normal(size=(500, 3))), rng.normal(0, 0.1, (500, 3))[..., None]], -1)
    moved = proposals.diffuse(poses, np.eye(6), metres=0.02, radians=0.3, rng=np.random.default_rng(4))
    twists = np.random.default_rng(4).normal(size=(500, 6)) * np.repeat([0.3, 0.02], 3)
    expected = compose(exp_so3(twists[:, :3]), poses[:, :, :3])
    assert moved[:, :, :3] == pytest.approx(expected, abs=1e-12)
    shift = rotate(moved[:, :, :3], centre) + moved[:, :, 3] - rotate(poses[:, :, :3], centre) - poses[:, :, 3]
    assert shift == pytest.approx(twists[:, 3:], abs=1e-12)


@given(vector=st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3), size=st.permutations([0.03, 0.075, 0.11]))
@settings(max_examples=25)
def test_a_box_that_lies_askew_in_its_frame_has_the_axes_of_its_faces(vector: list[float], size: list[float]) -> None:
    R = exp_so3(np.array(vector))
    corners = (np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3) - 0.5) * np.array(size)
    axes = box_axes(rotate(R[None], corners))
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9) and np.linalg.det(axes) == pytest.approx(1)
    extent = np.ptp(rotate(R[None], corners) @ axes, axis=0)
    # Unless the frame's own axes are nearly as good.
    assert np.prod(extent) <= np.prod(size) / 0.87


def test_catalogue_objects_keep_their_axes() -> None:
    for label in ("tea_box", "soup_can", "mug", "bowl"):
        assert box_axes(CATALOGUE[label].simplified(500).vertices) == pytest.approx(np.eye(3))


def test_flips_keep_the_centre_and_differ_from_one_another_modulo_symmetry() -> None:
    proposals = Proposals(CATALOGUE["tea_box"], 6)
    pose = np.concatenate([exp_so3(np.array([0.3, 0.2, 0.1])), [[0.1], [0.0], [0.8]]], 1)
    flips = proposals.all_flips(pose, TABLE)
    centre = CATALOGUE["tea_box"].bounds.mean(0)
    assert rotate(flips[..., :3], centre) + flips[..., 3] == pytest.approx(np.tile(pose[:, :3] @ centre + pose[:, 3],
                                                                                   (len(flips), 1)))  # fmt: skip
    angles = rotation_angle(flips[:, None, :, :3], flips[None, :, :, :3])
    assert angles[~np.eye(len(flips), dtype=bool)].min() > np.deg2rad(12)


def test_a_mug_is_round_but_for_its_handle_and_turns_about_its_body() -> None:
    found = round_body(CATALOGUE["mug"].simplified(500), np.eye(3))
    assert found is not None
    assert found[0] == pytest.approx([0, 0, 1]) and found[1] == pytest.approx([-0.0153, 0, 0], abs=0.001)
    assert all(
        round_body(CATALOGUE[label].simplified(500), np.eye(3)) is None
        for label in ("tea_box", "milk_carton", "sponge")
    )
    pose = np.concatenate([exp_so3(np.array([0.3, 0.2, 0.1])), [[0.1], [0.0], [0.8]]], 1)
    turns = Proposals(CATALOGUE["mug"], 6).all_flips(pose, TABLE)[-17:]
    assert turns[:, :, 2] == pytest.approx(np.tile(pose[:, 2], (17, 1)))
    axis = rotate(pose[None, :, :3], found[1])[0] + pose[:, 3]
    assert rotate(turns[:, :, :3], found[1]) + turns[:, :, 3] == pytest.approx(np.tile(axis, (17, 1)))
    degrees = np.rad2deg(rotation_angle(turns[:, :, :3], pose[:, :3]))
    assert np.sort(degrees) == pytest.approx([*np.repeat(np.arange(20, 180, 20), 2), 180])


def test_what_looks_the_same_all_around_is_not_turned() -> None:
    pose = np.concatenate([np.eye(3), [[0.1], [0.0], [0.8]]], 1)
    for label in ("soup_can", "cup", "bowl"):
        proposals = Proposals(CATALOGUE[label], 6)
        assert len(proposals.all_flips(pose, TABLE)) == 1 + len(proposals.flips)


@given(seed=st.integers(0, 1000), count=st.integers(1, 12))
@settings(max_examples=25)
def test_distinct_poses_are_the_cheapest_that_are_far_apart(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.concatenate([exp_so3(rng.normal(0, 0.1, (60, 3))), rng.normal(0, 0.01, (60, 3))[..., None]], -1)
    costs = rng.random(60)
    kept = distinct_best(poses, costs, count, metres=0.01, radians=0.15).tolist()

    def near(i: int, j: int) -> bool:
        close = np.linalg.norm(poses[i, :, 3] - poses[j, :, 3]) <= 0.01
        return bool(close and rotation_angle(poses[i, :, :3], poses[j, :, :3]) <= 0.15)

    expected: list[int] = []
    for i in np.argsort(costs):
        if len(expected) < count and not any(near(int(i), j) for j in expected):
            expected.append(int(i))
    assert kept == expected
