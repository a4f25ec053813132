"""The network's parts against hand-made cases, and its weights' file."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from runner.contract import Refused
from stages.perception.detection.trained.network import (
    HEIGHT,
    WIDTH,
    DetectionNetwork,
    anchor_boxes,
    clip,
    detect,
    fit,
    roi_align,
)


def ramp() -> torch.Tensor:
    """A map of 8 x 10 cells at stride 4 that holds each cell centre's x and y in image pixels."""
    y, x = torch.meshgrid((torch.arange(8) + 0.5) * 4, (torch.arange(10) + 0.5) * 4, indexing="ij")
    return torch.stack([x, y])[None]


def test_roi_align_of_a_linear_map_returns_the_cell_centres() -> None:
    x0, y0, x1, y1 = 6.0, 5.0, 27.0, 19.0
    regions = roi_align(ramp(), torch.tensor([[[x0, y0, x1, y1]]]), cells=7, stride=4)
    steps = (torch.arange(7) + 0.5) / 7
    torch.testing.assert_close(regions[0, 0], (x0 + (x1 - x0) * steps).expand(7, 7), atol=1e-4, rtol=0)
    torch.testing.assert_close(regions[0, 1], (y0 + (y1 - y0) * steps)[:, None].expand(7, 7), atol=1e-4, rtol=0)


def test_roi_align_takes_each_region_from_its_own_image() -> None:
    features = torch.cat([torch.zeros(1, 3, 8, 10), torch.ones(1, 3, 8, 10)])
    boxes = torch.tensor([[[0.0, 0, 20, 20], [4.0, 4, 9, 9]], [[0.0, 0, 20, 20], [8.0, 8, 30, 30]]])
    regions = roi_align(features, boxes, cells=2, stride=4)
    assert regions.shape == (4, 3, 2, 2)
    assert (regions[:2] == 0).all() and (regions[2:] == 1).all()


def test_anchors_follow_the_order_of_the_proposal_head() -> None:
    network = DetectionNetwork(("cup",)).eval()
    logits, offsets = network.proposals(torch.zeros(1, 96, HEIGHT // 8, WIDTH // 8))
    assert logits.shape[1] == offsets.shape[1] == len(anchor_boxes())
    centres = (anchor_boxes()[:, :2] + anchor_boxes()[:, 2:]) / 2
    assert centres[0].tolist() == [4, 4] and centres[3].tolist() == [12, 4]


def test_clipped_boxes_stay_inside_and_never_vanish() -> None:
    boxes = clip(torch.tensor([[-5.0, -5, 10, 10], [400.0, 400, 500, 500], [7.0, 7, 7, 7]]))
    assert boxes[0].tolist() == [0, 0, 10, 10]
    assert (boxes[:, 2:] - boxes[:, :2] >= 1).all() and boxes.min() >= 0
    assert boxes[1].tolist() == [WIDTH - 1, HEIGHT - 1, WIDTH, HEIGHT]


@pytest.mark.parametrize(("size", "scale"), [((480, 640), 0.5), ((240, 320), 1.0), ((400, 400), 0.6), ((90, 640), 0.5)])
def test_images_of_any_shape_are_scaled_to_fit(size: tuple[int, int], scale: float) -> None:
    image, used = fit(np.full((*size, 3), 200, np.uint8))
    assert image.shape == (HEIGHT, WIDTH, 3) and used == scale
    assert (image > 0).all(axis=-1).sum() == pytest.approx(size[0] * size[1] * scale**2, rel=0.01)


@pytest.mark.parametrize("size", [(360, 640), (640, 360)])
def test_boxes_end_where_an_image_of_any_shape_does(size: tuple[int, int]) -> None:
    torch.manual_seed(3)
    image = np.random.default_rng(0).integers(0, 255, (*size, 3)).astype(np.uint8)
    boxes = detect(DetectionNetwork(("cup",)).eval(), image, threshold=0.0, keep=64).boxes
    assert boxes.min() >= 0 and boxes[:, 2:].max(0) == pytest.approx(size[::-1])


def test_weights_survive_the_file_and_detect_the_same(tmp_path: Path) -> None:
    torch.manual_seed(3)
    DetectionNetwork(("cup", "tray")).save(tmp_path / "w.safetensors")
    network = DetectionNetwork.load(tmp_path / "w.safetensors")  # Rounded to half precision once.
    network.save(tmp_path / "w.safetensors")
    again = DetectionNetwork.load(tmp_path / "w.safetensors")
    assert again.labels == ("cup", "tray") and not again.training
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    first, second = (detect(n, image, threshold=0.01, keep=5) for n in (network, again))
    assert len(first.boxes) > 0
    np.testing.assert_array_equal(first.boxes, second.boxes)
    np.testing.assert_array_equal(first.confidences, second.confidences)


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    with pytest.raises(Refused, match=r"w\.safetensors"):
        DetectionNetwork.load(path)
    path.write_bytes(b"no weights at all")
    with pytest.raises(Refused, match=r"w\.safetensors: not the weights"):
        DetectionNetwork.load(path)
    save_file({"a": torch.zeros(1)}, path, metadata={"labels": '["cup"]'})
    with pytest.raises(Refused, match=r"w\.safetensors: not the weights"):
        DetectionNetwork.load(path)
