"""The joint refinement of a scene, and flips put right by colour."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose, rotate, symmetry_angle
from stages.perception.filter.settings import FilterSettings
from stages.perception.refinement.refinement import Placed, RefinedScene, RefinementSettings, SceneRefiner
from stages.scene.catalogue import Catalogue
from tests.stages.perception.painted import painted
from tests.stages.perception.scenes import CATALOGUE, VIEW, Rendered, camera, render, upright

PLACED = {"soup_can": upright("soup_can", -0.05, -0.05, 0.4), "tea_box": upright("tea_box", 0.06, 0.06, 0.2)}
OVER = pose(exp_so3(np.array([np.pi, 0.0, 0.0])), np.zeros(3))
STAYS = np.eye(4)
NUDGE = pose(exp_so3(np.array([0.02, -0.02, 0.02])), np.array([0.003, -0.002, 0.003]))
SPIN = CATALOGUE["soup_can"].symmetries.transforms()
AXIS = np.array([-0.0153, 0.0, 0.0])
"""Where the mug's body has its axis."""
PLAIN = {
    label: replace(item, mesh=replace(item.mesh, colors=np.full_like(item.mesh.colors, (180, 40, 30))))
    for label, item in CATALOGUE.objects.items()
}


@pytest.fixture(scope="module")
def seen() -> Rendered:
    return render(PLACED)


@pytest.fixture(scope="module")
def refiner() -> SceneRefiner:
    return SceneRefiner(CATALOGUE, RefinementSettings())


def image(seen: Rendered, catalogue: Catalogue = CATALOGUE, *, can: Floats = STAYS) -> np.ndarray:
    """What a camera would see; the can may be painted as if it stood otherwise than in depth."""
    poses = seen.poses | {"soup_can": seen.poses["soup_can"] @ can}
    return painted([(catalogue[label].mesh, T) for label, T in poses.items()], VIEW)


def nudged(seen: Rendered, *, can: Floats = NUDGE) -> list[Placed]:
    return [Placed("soup_can", seen.poses["soup_can"] @ can), Placed("tea_box", seen.poses["tea_box"] @ NUDGE)]


def turned(found: RefinedScene, seen: Rendered, catalogue: Catalogue = CATALOGUE) -> list[float]:
    """Degrees by which each object is turned, modulo symmetry."""
    return [
        float(np.rad2deg(symmetry_angle(item.T_camera_object[:, :3], seen.poses[item.label][:3, :3],
                                        catalogue[item.label].symmetries.transforms())))
        for item in found.objects
    ]  # fmt: skip


def test_a_can_upside_down_is_put_right(seen: Rendered, refiner: SceneRefiner) -> None:
    found = refiner.refine(seen.scene, image(seen), nudged(seen, can=OVER))
    assert max(turned(found, seen)) < 3
    assert [item.layer.shape for item in found.objects] == [seen.scene.depth.shape] * 2


def test_colour_decides_where_depth_finds_poses_equal(seen: Rendered, refiner: SceneRefiner) -> None:
    can = refiner.refine(seen.scene, image(seen, can=OVER), nudged(seen)).objects[0]
    assert symmetry_angle(can.T_camera_object[:, :3], (seen.poses["soup_can"] @ OVER)[:3, :3], SPIN) < np.deg2rad(3)
    (other,) = can.considered
    assert symmetry_angle(other.T_camera_object[:, :3], seen.poses["soup_can"][:3, :3], SPIN) < np.deg2rad(3)
    assert other.nats > 3


def test_symmetric_objects_are_turned_until_their_label_faces_as_in_the_image(
    seen: Rendered, refiner: SceneRefiner
) -> None:
    placed = nudged(seen, can=pose(exp_so3(np.array([0.0, 0.0, 2.5])), np.zeros(3)))
    can, box = refiner.refine(seen.scene, image(seen), placed).objects
    # The can's label is printed twice.
    twice = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])])
    assert symmetry_angle(can.T_camera_object[:, :3], seen.poses["soup_can"][:3, :3], twice) < np.deg2rad(8)
    assert can.facing == pytest.approx(0.5, abs=0.05)
    # Of the box two sides are painted alike, its top and bottom are not.
    assert box.T_camera_object[:, 2] @ seen.poses["tea_box"][:3, 2] > np.cos(np.deg2rad(3))
    plain = SceneRefiner(Catalogue(PLAIN), RefinementSettings())
    can = plain.refine(seen.scene, image(seen, Catalogue(PLAIN)), placed).objects[0]
    assert can.facing == pytest.approx(3 / 36, abs=0.01)


@pytest.mark.parametrize("why", ["switched off", "no image", "no colour"])
def test_without_colour_depth_stands(seen: Rendered, why: str) -> None:
    catalogue = Catalogue(PLAIN) if why == "no colour" else CATALOGUE
    rgb = image(seen, catalogue, can=OVER)
    settings = RefinementSettings(colour=why != "switched off")
    found = SceneRefiner(catalogue, settings).refine(seen.scene, 0 * rgb if why == "no image" else rgb, nudged(seen))
    assert turned(found, seen)[0] < 3


@pytest.mark.parametrize(("yaw", "degrees"), [(0.6, 160), (1.2, -100), (1.9, 160)])
def test_a_mug_whose_handle_is_out_of_sight_is_turned_as_its_label_says(
    refiner: SceneRefiner, yaw: float, degrees: float
) -> None:
    mug = render({"mug": upright("mug", 0.0, 0.04, yaw), "cup": upright("cup", 0.03, -0.05, 0.0)})
    axis = rotate(mug.poses["mug"][None, :3, :3], AXIS)[0] + mug.poses["mug"][:3, 3]
    false = pose(exp_so3(np.array([0.0, 0.0, np.deg2rad(degrees)])), np.zeros(3))
    false[:3, 3] = AXIS - false[:3, :3] @ AXIS
    rgb = painted([(CATALOGUE[label].mesh, T) for label, T in mug.poses.items()], VIEW)
    placed = [Placed("mug", mug.poses["mug"] @ false), Placed("cup", mug.poses["cup"])]
    found = refiner.refine(mug.scene, rgb, placed)
    assert turned(found, mug)[0] < 10
    T = found.objects[0].T_camera_object
    assert rotate(T[None, :, :3], AXIS)[0] + T[:, 3] == pytest.approx(axis, abs=0.003)


def test_colour_does_not_overrule_depth(seen: Rendered, refiner: SceneRefiner) -> None:
    mug = render({"mug": upright("mug", 0.0, 0.0, 0.6)})
    false = {"mug": mug.poses["mug"] @ pose(exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))}
    rgb = painted([(CATALOGUE[label].mesh, T) for label, T in false.items()], VIEW)
    found = refiner.refine(mug.scene, rgb, [Placed("mug", mug.poses["mug"])])
    assert turned(found, mug)[0] < 3


@pytest.mark.parametrize("quarter", [1, -1])
def test_a_flip_is_compared_by_the_symmetric_turn_that_fits(monkeypatch: pytest.MonkeyPatch, quarter: int) -> None:
    box = CATALOGUE["tea_box"]
    vertices = box.mesh.vertices * [1.0, 31 / 60, 1.0]  # a square section, one side of which bulges by 3 mm
    front = vertices[:, 1] < -0.0309
    vertices[front, 1] -= 0.003 * np.cos(np.pi * vertices[front, 0] / 0.062) * np.cos(np.pi * vertices[front, 2] / 0.08)
    bar = Catalogue({"tea_box": replace(box, mesh=replace(box.mesh, vertices=vertices))})
    monkeypatch.setattr("tests.stages.perception.scenes.CATALOGUE", bar)
    seen = render({"tea_box": upright("tea_box", 0.0, 0.0, 0.3)})
    start = seen.poses["tea_box"] @ pose(exp_so3(np.array([0.0, 0.0, quarter * np.pi / 2])), np.zeros(3))
    blank = np.zeros((VIEW.height, VIEW.width, 3), np.uint8)
    refined = SceneRefiner(bar, RefinementSettings(colour=False)).refine(seen.scene, blank, [Placed("tea_box", start)])
    assert turned(refined, seen, bar)[0] < 3


@pytest.mark.parametrize(("yaw", "x", "y"), [(1.51, -0.023, 0.026), (1.49, -0.017, 0.019), (1.56, -0.008, 0.025)])
def test_a_quarter_turn_about_the_end_that_shows_is_undone(
    refiner: SceneRefiner, yaw: float, x: float, y: float
) -> None:
    box = upright("cereal_box", 0.0, 0.0, yaw + 2.39)
    box[2, 3] += 0.044  # on the sponge, of which a third shows
    seen = render({"cereal_box": box, "sponge": upright("sponge", 0.0, 0.0, yaw)}, noise=0.0005)
    blank = np.zeros((VIEW.height, VIEW.width, 3), np.uint8)
    false = camera() @ upright("sponge", x, y, yaw + np.pi / 2)
    placed = [Placed("cereal_box", seen.poses["cereal_box"]), Placed("sponge", false)]
    found = refiner.refine(seen.scene, blank, placed)
    assert max(turned(found, seen)) < 5
    assert offset(found.objects[1].T_camera_object, seen.poses["sponge"]) < 0.005


def test_what_is_switched_off_in_the_filter_is_off_here(seen: Rendered) -> None:
    settings = RefinementSettings.of(FilterSettings().without("joint refinement", "contact"))
    assert (settings.rounds, settings.contact, settings.colour) == (0, False, FilterSettings().colour)


def test_polish_lowers_the_cost_and_comes_closer(seen: Rendered, refiner: SceneRefiner) -> None:
    placed = [Placed(label, T @ NUDGE) for label, T in seen.poses.items()]
    still = SceneRefiner(CATALOGUE, RefinementSettings(rounds=0, colour=False))
    before, after = (r.refine(seen.scene, image(seen), placed) for r in (still, refiner))
    assert after.cost < before.cost
    for item in after.objects:
        assert offset(item.T_camera_object, seen.poses[item.label]) < 0.0015


def offset(A: Floats, B: Floats) -> float:
    return float(np.linalg.norm(A[:3, 3] - B[:3, 3]))


def digest() -> str:
    torch.set_num_threads(1)  # as stages do: sums depend on how many share them
    seen = render({"soup_can": PLACED["soup_can"]})
    placed = [Placed("soup_can", seen.poses["soup_can"] @ NUDGE)]
    (can,) = SceneRefiner(CATALOGUE, RefinementSettings()).refine(seen.scene, image(seen, can=OVER), placed).objects
    odds = repr((can.facing, [each.nats for each in can.considered])).encode()
    return hashlib.sha256(can.T_camera_object.tobytes() + can.layer.tobytes() + odds).hexdigest()


def test_another_process_finds_the_same_bytes() -> None:
    code = "from tests.stages.perception.refinement.test_refinement import digest; print(digest())"
    root = Path(__file__).parents[4]
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert run.stdout.strip() == digest()
