"""The cost of a pose against its definition, written out pixel by pixel."""

import numpy as np
import pytest

from stages.geometry.poses import exp_so3, pose
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.observation.plane import height_above
from tests.stages.perception import oracle
from tests.stages.perception.scenes import CATALOGUE, K, render, upright

BOX = (110, 70, 210, 170)
REGION = (80, 40, 240, 200)
PLACED = {"mug": upright("mug", 0.0, 0.0, 0.6), "tea_box": upright("tea_box", 0.12, 0.06, 0.2)}


def definition(scene: ObservedScene, mesh, T: np.ndarray, background: np.ndarray, form: CostForm, *, plain: bool):
    """Equation 9 over the window: back-projected points of render and observation, pixel by pixel."""
    x0, y0, x1, y1 = REGION
    rays = scene.view.rays()
    rendered = oracle.inverse_depth(mesh, T, scene.view)
    total = 0.0
    for v in range(y0, y1):
        for u in range(x0, x1):
            if scene.depth[v, u] == 0:
                continue
            observed = rays[v, u] * scene.depth[v, u]
            inside = BOX[0] <= u < BOX[2] and BOX[1] <= v < BOX[3]
            length = np.linalg.norm(rays[v, u])
            missed = (1 / background[v, u] - scene.depth[v, u]) * length
            credit = abs(missed) if plain else min(max(missed, 0), form.truncation) * scene.foreground[v, u]
            credit *= inside
            if rendered[v, u] <= background[v, u]:
                total += credit
                continue
            distance = np.linalg.norm(rays[v, u] / rendered[v, u] - observed)
            hidden = (1 / rendered[v, u] - scene.depth[v, u]) * length > form.occluder_margin
            of_plane = (
                not plain and not scene.foreground[v, u] and above(scene, observed) <= 0.006 + 0.003 * observed[2] ** 2
            )
            free = length * abs(1 / scene.plane_inverse[v, u] - scene.depth[v, u]) if of_plane else 0.0
            explained = max(min(distance, form.truncation) - free, 0.0)
            total += credit + form.occluder_cost if hidden else explained
    return total


def above(scene: ObservedScene, point: np.ndarray) -> float:
    """Metres between a point (camera frame) and the plane."""
    return float(abs(scene.T_camera_table[:3, 2] @ (point - scene.T_camera_table[:3, 3])))


@pytest.mark.parametrize("plain", [True, False])
def test_cost_is_its_definition(plain: bool) -> None:
    seen = render(PLACED)
    form = CostForm.paper() if plain else CostForm(contact_slack=100.0)
    mesh = CATALOGUE["mug"].simplified(200)
    window = Window.of(seen.scene, seen.scene.plane_inverse, BOX, REGION, stride=1, form=form)
    likelihood = ObjectLikelihood(Shape.of(mesh), window, seen.scene, form)
    near = seen.poses["mug"] @ pose(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.01, -0.01, 0.02]))
    behind = pose(np.eye(3), np.array([0.0, 0.0, 0.04])) @ seen.poses["mug"]
    for T in (seen.poses["mug"], near, behind):
        expected = definition(seen.scene, mesh, T, seen.scene.plane_inverse, form, plain=plain)
        # Only what differs from the definition at silhouettes, by rounding, may remain.
        assert likelihood.costs(T[None, :3])[0] == pytest.approx(expected, rel=0.005, abs=0.1)


def cost_of(scene: ObservedScene, T: np.ndarray, form: CostForm) -> float:
    window = Window.of(scene, scene.plane_inverse, BOX, REGION, stride=1, form=form)
    return float(ObjectLikelihood(Shape.of(CATALOGUE["mug"].mesh), window, scene, form).costs(T[None, :3])[0])


def test_the_true_pose_costs_least() -> None:
    seen = render(PLACED)
    best = cost_of(seen.scene, seen.poses["mug"], CostForm())
    for offset in 0.02 * np.eye(3):
        assert cost_of(seen.scene, pose(np.eye(3), offset) @ seen.poses["mug"], CostForm()) > 1.5 * best


def test_the_floor_of_a_tray_pays_little_for_the_noise_of_the_plane_that_it_covers() -> None:
    seen = render({"tray": upright("tray", 0.0, 0.0, 0.3)}, noise=0.002)
    low = height_above(seen.scene.depth, seen.scene.view, seen.scene.T_camera_table) < 0.01
    scene = ObservedScene.of(seen.scene.depth, seen.scene.foreground & ~low, K, seen.scene.T_camera_table)
    x0, y0, x1, y1 = (int(value) for value in seen.boxes["tray"])
    shape, part = Shape.of(CATALOGUE["tray"].mesh), (x0, y0, x1, y1)
    window = Window.of(scene, scene.plane_inverse, part, part, stride=1, form=CostForm())
    likelihood = ObjectLikelihood(shape, window, scene, CostForm())
    (cost,) = likelihood.costs(seen.poses["tray"][None, :3])
    floor = int((low & (scene.factor > 0))[y0:y1, x0:x1].sum())
    assert cost < 0.5 * np.sqrt(2 / np.pi) * 0.002 * floor


def test_invalid_depth_is_no_evidence() -> None:
    seen = render(PLACED)
    nothing = np.zeros_like(seen.scene.depth)
    blind = ObservedScene.of(nothing, seen.scene.foreground, K, seen.scene.T_camera_table)
    assert cost_of(blind, seen.poses["mug"], CostForm(contact_slack=10.0)) == 0


def test_sinking_below_the_plane_costs_only_beyond_the_slack() -> None:
    seen = render({"mug": PLACED["mug"]}, noise=0.0)
    down = -seen.scene.T_camera_table[:3, 2]
    slack = CostForm().contact_slack

    def sunk(metres: float, form: CostForm) -> float:
        return cost_of(seen.scene, pose(np.eye(3), metres * down) @ seen.poses["mug"], form)

    free = CostForm(contact_slack=100.0)
    assert sunk(0.9 * slack, CostForm()) == pytest.approx(sunk(0.9 * slack, free))
    assert sunk(2.0 * slack, CostForm()) > sunk(2.0 * slack, free) + 100


def test_refinement_returns_to_the_truth() -> None:
    seen = render(PLACED)
    form = CostForm()
    window = Window.of(seen.scene, seen.scene.plane_inverse, BOX, REGION, stride=1, form=form)
    likelihood = ObjectLikelihood(Shape.of(CATALOGUE["mug"].mesh), window, seen.scene, form)
    start = seen.poses["mug"] @ pose(exp_so3(np.array([0.05, -0.05, 0.1])), np.array([0.008, 0.005, -0.006]))
    refined = likelihood.refine(start[None, :3], np.eye(6), steps=12, gate=0.03)
    assert np.linalg.norm(refined[0, :, 3] - seen.poses["mug"][:3, 3]) < 0.0015
    assert likelihood.costs(refined)[0] < likelihood.costs(start[None, :3])[0]
