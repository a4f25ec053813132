"""The built-in catalogue, BOP folders, symmetries and simplified meshes."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import stages.scene
from runner.contract import Refused
from stages.planning.motion.collision import add_primitives, quaternion
from stages.scene.catalogue import Catalogue, CatalogueObject, Grasp, Primitive, Symmetries
from stages.scene.catalogue.mesh_shape import axis_rotation, transform
from stages.scene.catalogue.properties import FINGER_CLEARANCE

BUILT_IN = Path(stages.scene.__file__).parent / "catalogue.yaml"
DATA = Path(__file__).parents[5] / "shared" / "data"
CATALOGUE = Catalogue.load(BUILT_IN)
NAMES = list(CATALOGUE.objects)
OPENING = 0.10
FINGER = 0.07
"""Metres from the palm of a Fetch to its fingertips."""
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the data sets in ../shared/data are absent")


def test_fifteen_objects_most_of_them_graspable() -> None:
    assert len(NAMES) == 15
    assert [CATALOGUE[name].label for name in NAMES] == list(range(1, 16))
    narrow = [name for name in NAMES if any(grasp.width < 0.085 for grasp in CATALOGUE[name].grasps)]
    assert len(narrow) >= 9


def test_absent_object_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(Refused, match=r"'teapot' is not in the catalogue, which has tray, plate"):
        CATALOGUE["teapot"]


@pytest.mark.parametrize("name", NAMES)
def test_grasps_are_rigid_and_come_from_ten_centimetres_back(name: str) -> None:
    for grasp in CATALOGUE[name].grasps:
        R = grasp.T_object_grasp[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1)
        np.testing.assert_allclose(grasp.T_object_grasp[:3, 3] - grasp.T_object_pregrasp[:3, 3], 0.10 * R[:, 0])
        assert 0 < grasp.width < OPENING
    assert len({grasp.name for grasp in CATALOGUE[name].grasps if grasp.kind == "top"}) == sum(
        grasp.kind == "top" for grasp in CATALOGUE[name].grasps
    )


@pytest.mark.parametrize("name", NAMES)
def test_no_grasp_is_deeper_than_fingers_are_long(name: str) -> None:
    for grasp in CATALOGUE[name].grasps:
        along = (CATALOGUE[name].mesh.vertices - grasp.T_object_grasp[:3, 3]) @ grasp.T_object_grasp[:3, 0]
        assert -along.min() < FINGER, grasp.name


@pytest.mark.parametrize("name", NAMES)
def test_fingers_reach_into_the_object_and_keep_off_the_table_as_it_stands_or_lies(name: str) -> None:
    entry = CATALOGUE[name]
    for grasp in entry.grasps:
        same = entry.symmetries.transforms(np.pi) @ grasp.T_object_grasp
        assert any(_is_clear_of_the_table(entry, T, R) for T in same for R in entry.resting), grasp.name


def _is_clear_of_the_table(entry: CatalogueObject, T_object_grasp: np.ndarray, R_table_object: np.ndarray) -> bool:
    """Whether the hand comes from above, its tips inside, or level and high enough for the palm."""
    heights = entry.mesh.vertices @ R_table_object[2]
    down, _, _, tips = R_table_object[2] @ T_object_grasp[:3] * [-1, 1, 1, 1]
    level = abs(down) < 1e-9
    above = down > np.cos(np.deg2rad(20))  # the wall of a vessel may lean, and the fingers with it
    room = 0.065 if level else FINGER_CLEARANCE
    return (level or above) and heights.min() + room - 1e-9 <= tips < heights.max()


@pytest.mark.parametrize("name", NAMES)
def test_open_fingers_pass_the_object_on_the_way_in(name: str) -> None:
    """Between pre-grasp and grasp, no part of the object lies where the open fingers' pads move."""
    entry = CATALOGUE[name]
    for grasp in entry.grasps:
        points = in_fingertip_frame(entry.mesh.vertices, grasp)
        swept = (points[:, 0] < 0) & (np.abs(points[:, 2]) < 0.010)
        outside = np.abs(np.abs(points[:, 1]) - OPENING / 2 - 0.005) < 0.005
        if "rim" not in grasp.name:
            assert not (swept & outside).any(), grasp.name


def in_fingertip_frame(vertices: np.ndarray, grasp: Grasp) -> np.ndarray:
    return (vertices - grasp.T_object_grasp[:3, 3]) @ grasp.T_object_grasp[:3, :3]


@pytest.mark.parametrize("name", NAMES)
def test_collision_geometry_covers_the_enclosing_box_and_no_more(name: str) -> None:
    entry = CATALOGUE[name]
    corners = np.concatenate([primitive_points(piece) for piece in entry.collision])
    assert np.abs(corners.min(0) - entry.bounds[0]).max() < 0.006
    assert np.abs(corners.max(0) - entry.bounds[1]).max() < 0.006


@pytest.mark.parametrize("name", ["bowl", "cup", "mug", "tray"])
def test_vessels_are_hollow_for_collisions_too(name: str) -> None:
    entry = CATALOGUE[name]
    x = -0.0153 if name == "mug" else 0.0
    inside = np.array([x, 0.0, entry.bounds[0, 2] + 0.5 * entry.dimensions[2]])
    assert entry.concave
    assert not any(contains(piece, inside) for piece in entry.collision)


def primitive_points(piece: Primitive) -> np.ndarray:
    if piece.kind == "box":
        local = (np.array(list(np.ndindex(2, 2, 2))) - 0.5) * piece.size
    else:
        angle = np.linspace(0, 2 * np.pi, 64)
        rim = piece.size[0] * np.column_stack([np.cos(angle), np.sin(angle)])
        local = np.concatenate([np.column_stack([rim, np.full(64, s * piece.size[1] / 2)]) for s in (-1, 1)])
    return local @ piece.T_object_primitive[:3, :3].T + piece.T_object_primitive[:3, 3]


def contains(piece: Primitive, point: np.ndarray) -> bool:
    local = np.linalg.inv(piece.T_object_primitive) @ np.append(point, 1)
    if piece.kind == "box":
        return bool((np.abs(local[:3]) < np.array(piece.size) / 2).all())
    return bool(np.hypot(local[0], local[1]) < piece.size[0] and abs(local[2]) < piece.size[1] / 2)


@pytest.mark.parametrize("name", NAMES)
def test_object_stays_in_each_of_its_resting_poses(name: str) -> None:
    entry = CATALOGUE[name]
    for R in entry.resting:
        height = -float((entry.mesh.vertices @ R.T)[:, 2].min())
        position, rotation = settled(entry, R, height)
        assert position[2] == pytest.approx(height, abs=0.002)
        np.testing.assert_allclose(rotation, R, atol=0.02)


def settled(entry: CatalogueObject, R: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation after half a second of physics on a plane."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    body = spec.worldbody.add_body(pos=[0, 0, height], quat=quaternion(R))
    body.add_freejoint()
    for geom in add_primitives(body, entry.collision):
        geom.mass = entry.mass / len(entry.collision)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=250)
    return data.xpos[1], data.xmat[1].reshape(3, 3)


@pytest.mark.parametrize("name", NAMES)
def test_symmetries_map_the_shape_onto_itself(name: str) -> None:
    entry = CATALOGUE[name]
    surface = trimesh.Trimesh(entry.mesh.vertices, entry.mesh.faces, process=False)
    for symmetry in entry.symmetries.transforms(np.deg2rad(90)):
        moved = entry.mesh.vertices[::150] @ symmetry[:3, :3].T + symmetry[:3, 3]
        distance = trimesh.proximity.closest_point_naive(surface, moved)[1]
        assert distance.max() < 5e-4


@pytest.mark.parametrize("name", NAMES)
def test_simplified_mesh_keeps_shape_and_orientation(name: str) -> None:
    entry = CATALOGUE[name]
    full, reduced = entry.mesh, entry.simplified(500)
    assert len(reduced.faces) <= 500
    assert entry.simplified(500) is reduced
    assert np.abs(reduced.vertices.min(0) - entry.bounds[0]).max() < 0.0015
    assert np.abs(reduced.vertices.max(0) - entry.bounds[1]).max() < 0.0015
    original, simple = (trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in (full, reduced))
    assert simple.is_watertight and simple.is_winding_consistent
    assert simple.volume == pytest.approx(original.volume, rel=0.03)
    samples = trimesh.sample.sample_surface(simple, 60, seed=1)[0]
    assert trimesh.proximity.closest_point_naive(original, samples)[1].mean() < 0.0003


def test_simplifying_is_repeatable_and_leaves_small_meshes_alone() -> None:
    again = Catalogue.shared(BUILT_IN)["mug"].simplified(400)
    assert Catalogue.shared(BUILT_IN)["mug"].simplified(400) is again
    np.testing.assert_array_equal(again.vertices, CATALOGUE["mug"].simplified(400).vertices)
    np.testing.assert_array_equal(again.faces, CATALOGUE["mug"].simplified(400).faces)
    assert CATALOGUE["mug"].simplified(10**6) is CATALOGUE["mug"].mesh


@settings(max_examples=30)
@given(st.floats(0.05, 1.0), st.tuples(*[st.floats(-0.1, 0.1)] * 3))
def test_continuous_symmetry_keeps_its_axis_in_place(step: float, offset: tuple[float, float, float]) -> None:
    axis = np.array([0.0, 0.6, 0.8])
    turns = Symmetries(np.zeros((0, 4, 4)), ((axis, np.array(offset)),), np.zeros((0, 4, 4))).transforms(step)
    np.testing.assert_array_equal(turns[0], np.eye(4))
    on_axis = np.append(np.array(offset) + 0.3 * axis, 1.0)
    np.testing.assert_allclose(turns @ on_axis, np.tile(on_axis, (len(turns), 1)), atol=1e-9)
    assert len(turns) == int(np.ceil(2 * np.pi / step))


def test_discrete_and_continuous_symmetries_combine() -> None:
    flip = transform(axis_rotation(np.array([1.0, 0, 0]), np.pi), np.zeros(3))
    z = (np.array([0.0, 0, 1]), np.zeros(3))
    transforms = Symmetries(flip[None], (z,), np.zeros((0, 4, 4))).transforms(np.deg2rad(90))
    assert transforms.shape == (8, 4, 4)
    assert len(np.unique(np.round(transforms.reshape(8, 16), 6), axis=0)) == 8


@needs_data
@pytest.mark.parametrize("dataset", ["ycb-real", "clutter-ycb", "household-layout"])
def test_bop_models_load_in_metres_with_names_and_symmetries(dataset: str) -> None:
    catalogue = Catalogue.load(DATA / dataset / "models")
    can, mustard = catalogue["002_master_chef_can"], catalogue["006_mustard_bottle"]
    assert can.label == 1
    np.testing.assert_allclose(can.dimensions, [0.1025, 0.1024, 0.1402], atol=2e-3)
    assert len(can.symmetries.continuous) == 1 and len(mustard.symmetries.near) == 1
    axis_point = can.symmetries.continuous[0][1]
    assert np.abs(axis_point[:2] - can.bounds.mean(0)[:2]).max() < 0.002
    assert catalogue["024_bowl"].concave and not can.concave
    assert all(entry.resting for entry in catalogue.objects.values())


def test_bop_object_without_a_name_is_named_after_its_file(tmp_path: Path) -> None:
    box = trimesh.creation.box((60.0, 80.0, 100.0))
    box.export(tmp_path / "obj_000007.ply")
    (tmp_path / "models_info.json").write_text('{"7": {"diameter": 141.4}}')
    entry = Catalogue.load(tmp_path)["obj_000007"]
    assert entry.label == 7
    np.testing.assert_allclose(entry.dimensions, [0.06, 0.08, 0.10], atol=1e-6)
    assert entry.grasps == () and entry.collision[0].kind == "box"
