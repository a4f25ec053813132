"""Training images: boxes around what is visible, hidden objects ignored, and their file."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Refused
from stages.perception.detection.trained.network import HEIGHT, WIDTH
from stages.perception.detection.trained.training_images import (
    DISTRACTOR,
    Body,
    Layout,
    labelled,
    load_examples,
    random_camera,
    random_texture,
    render_example,
    save_examples,
)
from stages.perception.rendering.renderer import Camera, Item, Renderer
from tests.stages.perception.rendering.test_renderer import at, box

K = np.array([[270.0, 0, 159.5], [0, 270, 119.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    renderer = Renderer(WIDTH, HEIGHT)
    yield renderer
    renderer.close()


def test_boxes_enclose_visible_pixels_and_hidden_objects_are_ignored(renderer: Renderer) -> None:
    """A large box in front of one that it hides almost wholly, one beside them, and a distractor."""
    items = [
        Item(box(0.20, 0.20, 0.02), at(0, 0, 0.8)),
        Item(box(0.20, 0.20, 0.02), at(0.03, 0, 0.9)),
        Item(box(0.10, 0.10, 0.02), at(-0.3, 0.1, 1.0)),
        Item(box(0.10, 0.10, 0.02), at(0.3, 0.1, 1.0)),
    ]
    camera = Camera(K, np.eye(4))
    identity, _ = renderer.instances(items, camera)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    example = labelled(image, identity, items, [4, 5, 6, DISTRACTOR], camera=camera, rng=np.random.default_rng(0))
    assert example.labels.tolist() == [4, 5, 6]
    assert example.ignored.tolist() == [False, True, False]
    rows, columns = np.nonzero(identity == 2)
    assert example.boxes[2].tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]


def test_examples_depend_on_the_random_generator_alone(renderer: Renderer) -> None:
    layout = Layout((Body(box(0.1, 0.1, 0.1), 2, at(0, 0, 0.05)),))
    first, again, other = (render_example(renderer, layout, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.boxes, again.boxes)
    assert not np.array_equal(first.image, other.image)


def test_an_empty_table_has_no_boxes(renderer: Renderer) -> None:
    example = render_example(renderer, Layout(()), np.random.default_rng(5))
    assert example.image.shape == (HEIGHT, WIDTH, 3)
    assert example.boxes.shape == (0, 4) and len(example.labels) == 0


@pytest.mark.parametrize("like_robot", [True, False])
def test_cameras_look_down_at_the_middle_of_the_table(like_robot: bool) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        camera = random_camera(rng, like_robot=like_robot)
        pose = camera.T_world_camera
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        middle = np.linalg.inv(pose) @ [0, 0, 0.03, 1]
        u, v = (camera.K @ middle[:3])[:2] / middle[2]
        assert 0 < u < WIDTH and 0 < v < HEIGHT and 0.4 < middle[2] < 1.7 and pose[2, 3] > 0.2


def test_textures_are_images_of_one_size() -> None:
    rng = np.random.default_rng(0)
    textures = [random_texture(rng) for _ in range(20)]
    assert {texture.shape for texture in textures} == {(128, 128, 3)}
    assert len({texture.tobytes() for texture in textures}) == 20


def test_the_file_returns_the_examples(renderer: Renderer, tmp_path: Path) -> None:
    layout = Layout((Body(box(0.1, 0.1, 0.1), 1, at(0, 0, 0.05)), Body(box(0.05, 0.05, 0.2), 0, at(0.1, 0.1, 0.1))))
    made = [render_example(renderer, scene, np.random.default_rng(4)) for scene in (layout, Layout(()), layout)]
    save_examples(tmp_path / "some.npz", made, ["cup", "tray"])
    loaded, labels = load_examples(tmp_path / "some.npz")
    assert labels == ("cup", "tray") and len(loaded) == 3
    for one, other in zip(made, loaded, strict=True):
        np.testing.assert_array_equal(one.boxes, other.boxes)
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.ignored, other.ignored)
        assert np.abs(one.image.astype(int) - other.image).mean() < 8  # JPEG and noise.


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.npz").write_bytes(b"PK nothing")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name in ("absent.npz", "bad.npz", "other.npz"):
        with pytest.raises(Refused, match=name):
            load_examples(tmp_path / name)
