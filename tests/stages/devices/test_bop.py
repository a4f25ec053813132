"""BOP data sets: what the real ones hold, and one clear line for each kind of damage."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from runner.contract import Refused
from stages.devices.bop import read_dataset

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the data sets in ../shared/data are absent")
CAMERA = {"cam_K": [500.0, 0, 7.5, 0, 501.0, 5.5, 0, 0, 1], "depth_scale": 0.1}
TARGETS = [
    {"scene_id": 2, "im_id": 5, "obj_id": 1, "inst_count": 1},
    {"scene_id": 2, "im_id": 3, "obj_id": 1, "inst_count": 2},
    {"scene_id": 2, "im_id": 5, "obj_id": 4, "inst_count": 1},
]


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    scene = tmp_path / "test" / "000002"
    for folder in ("rgb", "depth"):
        (scene / folder).mkdir(parents=True)
    for image in (3, 5):
        pixels = np.full((12, 16, 3), image, np.uint8)
        Image.fromarray(pixels).save(scene / "rgb" / f"{image:06d}.png")
        Image.fromarray(np.full((12, 16), 1000 * image, np.uint16)).save(scene / "depth" / f"{image:06d}.png")
    (scene / "scene_camera.json").write_text(json.dumps({"3": CAMERA, "5": CAMERA}))
    (tmp_path / "test_targets_bop19.json").write_text(json.dumps(TARGETS))
    return tmp_path


def test_images_come_in_the_order_of_the_targets_with_their_object_counts(dataset: Path) -> None:
    images = read_dataset(dataset)
    assert [(image.scene_id, image.image_id, image.n_objects) for image in images] == [(2, 5, 2), (2, 3, 2)]
    np.testing.assert_array_equal(images[0].K, [[500, 0, 7.5], [0, 501, 5.5], [0, 0, 1]])


def test_depth_is_metres_and_colour_is_rgb(dataset: Path) -> None:
    rgb, depth = read_dataset(dataset)[0].read()
    assert rgb.shape == (12, 16, 3) and rgb.dtype == np.uint8 and (rgb == 5).all()
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, 0.5, rtol=1e-6)


def test_colour_may_be_jpeg(dataset: Path) -> None:
    scene = dataset / "test" / "000002"
    with Image.open(scene / "rgb" / "000005.png") as image:
        image.save(scene / "rgb" / "000005.jpg")
    (scene / "rgb" / "000005.png").unlink()
    assert read_dataset(dataset)[0].rgb.suffix == ".jpg"


def edit_camera(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def edit(dataset: Path) -> None:
        cameras = {"3": dict(CAMERA), "5": dict(CAMERA)}
        change(cameras)
        (dataset / "test" / "000002" / "scene_camera.json").write_text(json.dumps(cameras))

    return edit


def delete(name: str) -> Callable[[Path], None]:
    return lambda dataset: (dataset / name).unlink()


def write(name: str, text: str) -> Callable[[Path], object]:
    return lambda dataset: (dataset / name).write_text(text)


def shrink_depth(dataset: Path) -> None:
    Image.fromarray(np.zeros((6, 8), np.uint16)).save(dataset / "test/000002/depth/000003.png")


def depth_of_mode(mode: str) -> Callable[[Path], None]:
    return lambda dataset: Image.new(mode, (16, 12), 100).save(dataset / "test/000002/depth/000003.png")


DAMAGES = [
    (delete("test/000002/depth/000003.png"), r"000002/depth/000003\.png: the depth image is missing"),
    (delete("test/000002/rgb/000005.png"), r"000002/rgb/000005\.png: the colour image is missing"),
    (delete("test/000002/scene_camera.json"), r"scene_camera\.json: cannot be read: No such file"),
    (delete("test_targets_bop19.json"), r"test_targets_bop19\.json: cannot be read: No such file"),
    (shrink_depth, r"depth/000003\.png: 8 x 6 pixels, but the colour image has 16 x 12"),
    (depth_of_mode("L"), r"depth/000003\.png: an image of mode L; depth is one channel of 16 bits \(I;16, I;16B, I\)"),
    (depth_of_mode("P"), r"depth/000003\.png: an image of mode P; depth is one channel of 16 bits"),
    (depth_of_mode("RGB"), r"depth/000003\.png: an image of mode RGB; depth is one channel of 16 bits"),
    (edit_camera(lambda c: c.pop("5")), r"scene_camera\.json: image 5 is missing; there are 3"),
    (edit_camera(lambda c: c["5"].pop("cam_K")), r"scene_camera\.json: image 5: .*`cam_K`"),
    (edit_camera(lambda c: c["5"].pop("depth_scale")), r"scene_camera\.json: image 5: .*`depth_scale`"),
    (edit_camera(lambda c: c["5"].update(cam_K=[1.0])), r"scene_camera\.json: image 5: .*length >= 9.*cam_K"),
    (edit_camera(lambda c: c["5"].update(cam_K=[9, 1, 8, 0, 9, 6, 0, 0, 1])), r"image 5: cam_K: K = .*without skew"),
    (edit_camera(lambda c: c["5"].update(depth_scale=0)), r"scene_camera\.json: image 5: .*> 0.*depth_scale"),
    (write("test/000002/depth/000005.png", "png?"), r"depth/000005\.png: not a readable image"),
    (write("test_targets_bop19.json", "[]"), r"test_targets_bop19\.json: lists no images"),
    (write("test_targets_bop19.json", "[{}]"), r"test_targets_bop19\.json: .*missing required field `scene_id`"),
    (write("test_targets_bop19.json", "[{"), r"test_targets_bop19\.json: "),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_damage_is_refused_before_the_first_image(
    dataset: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(dataset)
    with pytest.raises(Refused) as refusal:
        read_dataset(dataset)
    assert re.search(message, str(refusal.value)), str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_scale_that_turns_metres_into_millimetres_is_refused(dataset: Path) -> None:
    edit_camera(lambda c: c["5"].update(depth_scale=1e-4))(dataset)
    image, _ = read_dataset(dataset)
    with pytest.raises(Refused, match=r"5\.png: median depth is 0\.0005 m; .*; a unit is depth_scale = 0\.0001 milli"):
        image.read()


def test_missing_data_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"nowhere: no such data set folder; it holds test_targets_bop19\.json"):
        read_dataset(tmp_path / "nowhere")


@needs_data
@pytest.mark.parametrize(
    ("name", "images", "objects"), [("ycb-real", 5, 13), ("clutter-ycb", 10, 60), ("household-layout", 11, 40)]
)
def test_real_data_sets_are_read(name: str, images: int, objects: int) -> None:
    listed = read_dataset(DATA / name)
    assert (len(listed), sum(image.n_objects for image in listed)) == (images, objects)
    rgb, depth = listed[0].read()
    assert rgb.shape == (480, 640, 3) and depth.shape == (480, 640)
    assert 0.4 < np.median(depth[depth > 0]) < 2.5
