"""Contact against distances known by construction."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trimesh.triangles import closest_point

from stages.geometry.poses import exp_so3, pose
from stages.perception.refinement.contact import ContactForm, Contacts, Solid, apparent, contacts, penalty
from tests.stages.perception.scenes import CATALOGUE, camera, upright

SPONGE_HEIGHT, SPONGE_WIDTH = 0.044, 0.07
SURFACE = 0.0015
"""How well the distance to a surface is known, metres: the meshes have rounded edges and are simplified."""


@cache
def solid(label: str) -> Solid:
    return Solid.of(CATALOGUE[label])


def touching(placed: list[tuple[str, np.ndarray]], T_camera_table: np.ndarray | None = None) -> Contacts:
    T = camera() if T_camera_table is None else T_camera_table
    return contacts([solid(label) for label, _ in placed], np.stack([T @ T_object for _, T_object in placed]), T)


def lifted(label: str, x: float, y: float, yaw: float, height: float) -> np.ndarray:
    return pose(np.eye(3), np.array([0.0, 0.0, height])) @ upright(label, x, y, yaw)


@pytest.mark.parametrize("label", ["mug", "tea_box", "tray"])
def test_the_grid_has_the_distance_and_the_side_of_every_triangle_asked(label: str) -> None:
    """All triangles at once, and the winding number as an angle of vectors (Van Oosterom and Strackee)."""
    grid, mesh = solid(label).grid, CATALOGUE[label].simplified(500)
    nodes = np.random.default_rng(1).integers(0, grid.shape, (300, 3))
    points = (CATALOGUE[label].bounds[0] - 2 * solid(label).spacing) + nodes * solid(label).spacing
    triangles = np.tile(mesh.vertices[mesh.faces], (len(points), 1, 1))
    queries = np.repeat(points, len(mesh.faces), 0)
    away = np.linalg.norm(closest_point(triangles, queries) - queries, axis=1).reshape(len(points), -1).min(1)
    a, b, c = np.moveaxis(triangles - queries[:, None], 1, 0)
    x, y, z = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    solids = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
    winding = np.arctan2((a * np.cross(b, c)).sum(1), solids).reshape(len(points), -1).sum(1) / (2 * np.pi)
    found = grid[tuple(nodes.T)]
    assert np.abs(found) == pytest.approx(away, abs=1e-7)
    off = away > 1e-6
    assert ((found < 0) == (winding > 0.5))[off].all()


@given(depth=st.floats(0.003, 0.02), yaw=st.floats(-3.0, 3.0))
@settings(max_examples=20)
def test_penetration_is_as_deep_as_one_box_reaches_into_another(depth: float, yaw: float) -> None:
    lower, upper = upright("sponge", 0.0, 0.0, yaw), lifted("sponge", 0.0, 0.0, yaw, SPONGE_HEIGHT - depth)
    found = touching([("sponge", lower), ("sponge", upper)])
    assert found.penetration[0, 1] == found.penetration[1, 0] == pytest.approx(depth, abs=SURFACE)


@given(gap=st.floats(0.002, 0.1), yaw=st.floats(-3.0, 3.0))
@settings(max_examples=20)
def test_the_gap_is_the_way_to_what_would_carry_the_object(gap: float, yaw: float) -> None:
    lower, upper = upright("sponge", 0.0, 0.0, 0.0), lifted("mug", 0.01, 0.0, yaw, SPONGE_HEIGHT + gap)
    found = touching([("sponge", lower), ("mug", upper)])
    assert found.gap == pytest.approx([0.0, gap], abs=SURFACE)
    assert found.penetration.max() == 0


@given(turn=st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
@settings(max_examples=10)
def test_contact_does_not_depend_on_where_the_camera_is(turn: list[float]) -> None:
    placed = [("sponge", upright("sponge", 0.0, 0.0, 0.4)), ("mug", lifted("mug", 0.02, 0.0, 0.0, 0.03))]
    here, there = touching(placed), touching(placed, pose(exp_so3(np.array(turn)), np.array([0.1, -0.2, 0.9])))
    assert there.penetration == pytest.approx(here.penetration, abs=1e-5)
    assert there.gap == pytest.approx(here.gap, abs=1e-5)


def test_what_lies_in_a_bowl_is_not_inside_of_it() -> None:
    inside = lifted("salt_shaker", 0.0, 0.0, 0.0, 0.0105)
    found = touching([("bowl", upright("bowl", 0.0, 0.0, 0.0)), ("salt_shaker", inside)])
    assert found.penetration.max() < 0.002
    assert found.gap.max() < 0.003
    pushed = lifted("salt_shaker", 0.06, 0.0, 0.0, 0.006)
    assert touching([("bowl", upright("bowl", 0.0, 0.0, 0.0)), ("salt_shaker", pushed)]).penetration[0, 1] > 0.01


def test_a_wall_beside_an_object_does_not_carry_it() -> None:
    beside = lifted("sponge", SPONGE_WIDTH + 0.001, 0.0, 0.0, 0.03)
    found = touching([("sponge", upright("sponge", 0.0, 0.0, 0.0)), ("sponge", beside)])
    assert found.gap[1] == pytest.approx(0.03, abs=SURFACE)


def test_sinking_is_measured_below_the_plane() -> None:
    found = touching([("mug", lifted("mug", 0.0, 0.0, 0.3, -0.02))])
    assert found.sunk[0] == pytest.approx(0.02, abs=SURFACE) and found.gap[0] == 0


def test_contact_costs_only_beyond_the_slack() -> None:
    form, pixels = ContactForm(), np.array([1000.0, 400.0])

    def cost(penetration: float = 0.0, sunk: float = 0.0, gap: float = 0.0) -> float:
        pair = penetration * (1 - np.eye(2))
        return penalty(Contacts(pair, np.array([sunk, 0.0]), np.array([0.0, gap])), pixels, form)

    assert cost(form.penetration_slack, form.plane_slack, form.plane_slack) == 0
    assert cost(penetration=form.penetration_slack + 0.01) == pytest.approx(form.penetration_weight * 0.01 * 400)
    assert cost(sunk=form.plane_slack + 0.01) == pytest.approx(form.penetration_weight * 0.01 * 1000)
    assert cost(gap=form.plane_slack + 1.0) == pytest.approx(form.floating_weight * form.most * 400)


def test_apparent_size_is_that_of_the_shadow() -> None:
    placed = camera() @ upright("soup_can", 0.0, 0.0, 0.0)
    radius, height = 0.034, 0.1
    shadow = (2 * np.pi * radius * height + 2 * np.pi * radius**2) / 4
    expected = shadow * (260 / placed[2, 3]) ** 2
    assert apparent([solid("soup_can")], placed[None], 260.0) == pytest.approx([expected], rel=0.05)


def test_no_objects_touch_nothing() -> None:
    found = contacts([], np.zeros((0, 3, 4)), camera())
    assert penalty(found, np.zeros(0)) == 0
