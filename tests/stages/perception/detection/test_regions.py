"""What stands on a table is found, whatever the table's place in the image; walls carry nothing."""

import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.perception.detection.boxes import intersection_over_union
from stages.perception.detection.regions import ImageRegion, regions
from stages.perception.detection.supports import supports
from tests.stages.perception.detection.scenes import NAMES, T_TABLE_CAMERA, VIEW, Photograph, photograph
from tests.stages.perception.scenes import CATALOGUE


def found(seen: Photograph, *, most: int = 60, seed: int = 0) -> list[ImageRegion]:
    rng = np.random.default_rng(seed)
    return regions(seen.rgb, seen.depth, VIEW, rng, up=None, sizes=(0.02, 0.4), most=most)


def best(seen: Photograph, name: str, among: list[ImageRegion]) -> tuple[ImageRegion, float]:
    overlaps = intersection_over_union(seen.boxes[name][None], np.stack([region.box for region in among]))[0]
    return among[int(overlaps.argmax())], float(overlaps.max())


@pytest.mark.parametrize("name", NAMES)
def test_each_object_is_a_region_with_its_size(name: str) -> None:
    seen = photograph(*NAMES)
    region, overlap = best(seen, name, found(seen))
    assert overlap > 0.75
    assert region.top == pytest.approx(CATALOGUE[name].dimensions[2], abs=0.03)
    assert 25 < region.elevation < 50
    x0, y0, x1, y1 = region.box
    assert region.mask.shape == (y1 - y0, x1 - x0)
    assert region.extent == pytest.approx(((x1 - x0) / 420 * 0.9, (y1 - y0) / 420 * 0.9), rel=0.2)


def test_the_clearest_regions_come_first() -> None:
    some = found(photograph(*NAMES), most=12)
    assert len(some) == 12
    scores = [region.objectness for region in some]
    assert scores == sorted(scores, reverse=True)


def test_a_frame_gives_the_same_regions_again() -> None:
    first, second = (found(photograph(*NAMES), seed=3) for _ in range(2))
    np.testing.assert_array_equal([one.box for one in first], [one.box for one in second])


def test_without_any_reading_or_any_object_there_is_nothing_or_little() -> None:
    empty = photograph()
    assert found(Photograph(empty.rgb, np.zeros_like(empty.depth), {})) == []
    assert len(found(empty)) <= 3


def test_without_a_plane_objects_are_still_told_apart_by_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.perception.detection.regions.supports", lambda *_: [])
    seen = photograph("cereal_box")
    x0, y0, x1, y1 = seen.boxes["cereal_box"].astype(int)
    depth = np.full_like(seen.depth, 5.0)
    depth[y0:y1, x0:x1] = seen.depth[y0:y1, x0:x1]
    region, overlap = best(seen, "cereal_box", found(Photograph(seen.rgb, depth, seen.boxes)))
    assert overlap > 0.6 and np.isnan(region.top) and np.isnan(region.elevation)


def planes(depth: np.ndarray, up: Floats | None = None) -> list[Floats]:
    return [support.normal for support in supports(depth, depth, VIEW, np.random.default_rng(0), up)]


def test_the_table_is_the_support_and_heights_are_above_it() -> None:
    seen = photograph("cereal_box")
    support = supports(seen.depth, seen.depth, VIEW, np.random.default_rng(0), None)[0]
    assert support.normal == pytest.approx(T_TABLE_CAMERA[2, :3], abs=0.02)
    x0, y0, x1, y1 = seen.boxes["cereal_box"].astype(int)
    assert support.over[y0:y1, x0:x1].mean() > 0.8
    heights = support.height[y0:y1, x0:x1][seen.depth[y0:y1, x0:x1] > 0]
    assert np.percentile(heights, 98) == pytest.approx(CATALOGUE["cereal_box"].dimensions[2], abs=0.03)


def test_a_wall_before_a_level_camera_is_a_support_only_where_gravity_does_not_say_otherwise() -> None:
    rays = VIEW.rays()
    floor = 0.15 / np.maximum(rays[..., 1], 1e-3)
    depth = np.minimum(floor, 1.0).astype(np.float32)
    up = np.array([0.0, -1.0, 0.0])
    assert all(normal == pytest.approx(up, abs=0.02) for normal in planes(depth, up))
    assert any(normal == pytest.approx(up, abs=0.02) for normal in planes(depth))
