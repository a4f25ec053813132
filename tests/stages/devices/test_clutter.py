"""Clutter: the same bytes for a seed, other scenes for another, and a truth that agrees with the images."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.datasets import images, truths_by_image
from benchmarks.comparison.clutter import sheet
from stages.devices.bop import read_dataset
from stages.devices.clutter import COUNTS, LEAST_VISIBLE, Clutter, Pile, write_clutter
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Catalogue

CATALOGUE = Catalogue.load(Path(__file__).parents[3] / "stages/scene/catalogue.yaml")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clutter")
    write_clutter(folder, CATALOGUE, scenes=2, seed=3)
    return folder


def test_a_seed_gives_the_same_bytes_and_another_seed_another_scene(dataset: Path, tmp_path: Path) -> None:
    for seed in (3, 4):
        write_clutter(tmp_path / str(seed), CATALOGUE, scenes=1, seed=seed)
    files = [file.relative_to(tmp_path / "3") for file in sorted((tmp_path / "3").rglob("*.*")) if file.is_file()]
    shared = [file for file in files if file.parts[0] in ("models", "test")]
    assert len(shared) == 16 + 5
    for file in shared:
        assert (tmp_path / "3" / file).read_bytes() == (dataset / file).read_bytes(), file
    assert (tmp_path / "3" / shared[-1]).read_bytes() != (tmp_path / "4" / shared[-1]).read_bytes()


def test_rendered_truth_agrees_with_the_depth_images(dataset: Path) -> None:
    catalogue = Catalogue.load(dataset / "models")
    names = {item.label: item.name for item in catalogue.objects.values()}
    for image in images(dataset, dataset / "detections_exact.json"):
        view = View.of(image.K, image.depth.shape[1], image.depth.shape[0])
        layers = [
            inverse_depth(Soup.of(catalogue[names[truth.label]].mesh), truth.T_camera_object, view)
            for truth in image.truths
        ]
        nearest = np.maximum.reduce(layers)
        seen = (nearest > 0) & (image.depth > 0)
        errors = np.abs(image.depth[seen] - 1 / nearest[seen])
        assert np.median(errors) < 0.003 and np.mean(errors < 0.02) > 0.93
        for truth, layer in zip(image.truths, layers, strict=True):
            assert truth.visible == pytest.approx(
                ((layer > 0) & (layer >= nearest)).sum() / (layer > 0).sum(), abs=0.02
            )
            assert truth.visible >= LEAST_VISIBLE


def test_models_keep_colours_and_symmetries(dataset: Path) -> None:
    loaded = Catalogue.load(dataset / "models")
    assert list(loaded.objects) == list(CATALOGUE.objects)
    for name, item in CATALOGUE.objects.items():
        copy = loaded[name]
        np.testing.assert_allclose(copy.mesh.vertices, item.mesh.vertices, atol=1e-7)
        np.testing.assert_array_equal(copy.mesh.faces, item.mesh.faces)
        np.testing.assert_array_equal(copy.mesh.colors, item.mesh.colors)
        np.testing.assert_allclose(copy.symmetries.transforms(), item.symmetries.transforms(), atol=1e-9)
        np.testing.assert_allclose(copy.symmetries.near, item.symmetries.near, atol=1e-9)
        assert copy.concave == item.concave and copy.label == item.label


def test_boxes_hold_what_is_seen_and_noisy_ones_add_objects_that_are_absent(dataset: Path) -> None:
    for exact, noisy in zip(
        images(dataset, dataset / "detections_exact.json"), images(dataset, dataset / "detections_noisy.json"),
        strict=True,
    ):  # fmt: skip
        labels = [box.label for box in exact.boxes]
        assert len(labels) == exact.n_objects == len(exact.truths) == len(set(labels))
        assert [box.label for box in noisy.boxes[: len(labels)]] == labels
        false = noisy.boxes[len(labels) :]
        assert 2 <= len(false) <= 3 and not {box.label for box in false} & set(labels)
        for box, jittered in zip(exact.boxes, noisy.boxes, strict=False):
            size = box.box[2:] - box.box[:2]
            assert (np.abs(box.box - jittered.box) < 0.6 * np.tile(size, 2)).all()
    info = json.loads((dataset / "test/000001/scene_gt_info.json").read_text())["0"]
    assert [list(map(int, box.box[:2])) for box in next(iter(images(dataset, dataset / "detections_exact.json"))).boxes
            ] == [each["bbox_visib"][:2] for each in info]  # fmt: skip


def test_twenty_scenes_show_104_objects_of_all_kinds() -> None:
    clutter = Clutter(CATALOGUE)
    chosen = clutter.chosen(20)
    clutter.close()
    assert [len(labels) for labels in chosen] == [*COUNTS, *COUNTS] and sum(map(len, chosen)) == 104
    assert all(len(set(labels)) == len(labels) for labels in chosen)
    assert sorted(Counter(label for labels in chosen for label in labels).values())[0] >= 6


def test_the_data_set_is_one_of_bop(dataset: Path) -> None:
    assert [image.n_objects for image in read_dataset(dataset)] == list(COUNTS[:2])
    assert sorted(truths_by_image(dataset)) == [(1, 0), (2, 0)]


def test_the_sheet_shows_every_image(dataset: Path) -> None:
    pixels = np.asarray(sheet(dataset))
    assert pixels.shape[0] == 195 and (pixels[:, :255].std(), pixels[:, 259:514].std()) > (1, 1)
    assert (pixels[:, 514:] == 255).all()


def test_a_pile_of_its_own_holds_what_it_says(tmp_path: Path) -> None:
    labels = ("mug", "soup_can", "tea_box", "sugar_box")
    pile = Pile(counts=(3,), labels=labels, least_visible=0.05, distance=(1.5, 1.6), jitter=0.0, false=(4, 4))
    write_clutter(tmp_path, CATALOGUE, scenes=2, seed=5, pile=pile)
    known = {CATALOGUE[label].label for label in labels}
    exact = images(tmp_path, tmp_path / "detections_exact.json")
    noisy = images(tmp_path, tmp_path / "detections_noisy.json")
    for image, other in zip(exact, noisy, strict=True):
        assert len(image.truths) == 3 and {truth.label for truth in image.truths} <= known
        assert all(truth.visible >= 0.05 and truth.T_camera_object[2, 3] > 1.2 for truth in image.truths)
        assert len(other.boxes) == 3 + 4
        for a, b in zip(image.boxes, other.boxes, strict=False):
            np.testing.assert_allclose(a.box, b.box)
