"""Half of a catalogue, and the same scene by another camera."""

from pathlib import Path

import numpy as np

from benchmarks.common.variations import by_another_camera, half
from stages.devices.clutter import write_models
from stages.messages import Frame
from stages.perception.detection.views import Views
from stages.scene.catalogue import Catalogue
from tests.stages.perception.detection.scenes import NAMES, OBJECTS


def test_half_of_a_catalogue_has_the_views_of_its_objects(tmp_path: Path) -> None:
    write_models(tmp_path / "models", OBJECTS)
    label = np.array([0, 0, 1, 2, 2, 2])
    flat = np.arange(6, dtype=np.float32)
    wide = {"middle": 112, "last": 320, "chroma": 144, "light": 6, "extent": 2}
    grid = np.zeros((6, 64, 64), np.float32)
    views = Views(
        labels=NAMES, label=label, elevation=flat, top=flat, grid=grid, covered=np.zeros((6, 64), bool),
        outline=np.zeros((6, 576), bool), basis=np.eye(112, 64, dtype=np.float32),
        **{name: np.zeros((6, width), np.float32) for name, width in wide.items()},
    )  # fmt: skip
    (tmp_path / "linked").write_text("models")  # as git writes a link where it may not make one
    numbers = {name: item.label for name, item in Catalogue.load(tmp_path / "models").objects.items()}
    for odd in (False, True):
        found = half(tmp_path / "linked", views, odd, tmp_path / str(odd))
        names = tuple(Catalogue.load(found.catalogue).objects)
        assert names == tuple(name for name in NAMES if numbers[name] % 2 == odd)
        kept = Views.of(found.catalogue, found.learned, place="here")
        assert [kept.labels[k] for k in kept.label] == [NAMES[k] for k in label if NAMES[k] in names]
        assert kept.elevation.tolist() == [float(i) for i, k in enumerate(label) if NAMES[k] in names]


def test_another_camera_sees_the_same_scene_farther_away() -> None:
    rgb, depth = np.full((48, 64, 3), 128, np.uint8), np.full((48, 64), 1.0, np.float32)
    depth[:, 30:] = 0
    frame = Frame(
        rgb=rgb, depth=depth, K=np.eye(3), T_base_camera=None, robot_mask=None, name="a", index=0, total=1,
        scene_id=1, image_id=0,
    )  # fmt: skip
    (seen, farther), (again, _), (other, _) = (by_another_camera(frame, seed) for seed in (1, 1, 2))
    assert 0.98 < farther < 1.02
    assert abs(float(seen.depth[seen.depth > 0].mean()) - farther) < 0.001
    assert seen.rgb.tobytes() == again.rgb.tobytes() != other.rgb.tobytes()
