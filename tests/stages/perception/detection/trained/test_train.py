"""What the network is told to learn: augmented boxes, targets of anchors and regions, the learning rate."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from stages.perception.detection.boxes import intersection_over_union
from stages.perception.detection.trained.network import HEIGHT, WIDTH, DetectionNetwork, anchor_boxes
from stages.perception.detection.trained.offsets import apply_offsets
from stages.perception.detection.trained.train import (
    REGIONS,
    anchor_targets,
    augmented,
    losses,
    region_targets,
    schedule,
)
from stages.perception.detection.trained.training_images import Example

BACKGROUND = 15


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Threads that wait for each other on busy cores take minutes for what one does in a second."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def example(*boxes: tuple[float, float, float, float], ignored: bool = False) -> Example:
    """Red rectangles on black, labelled 3, 4, ..."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for x0, y0, x1, y1 in np.array(boxes, int).reshape(-1, 4):
        image[y0:y1, x0:x1] = (255, 0, 0)
    count = len(boxes)
    return Example(image, np.array(boxes, float).reshape(-1, 4), 3 + np.arange(count), np.full(count, ignored))


@pytest.mark.parametrize("seed", range(8))
def test_augmented_boxes_still_enclose_their_object(seed: int) -> None:
    changed = augmented(example((130, 90, 190, 150)), np.random.default_rng(seed))
    red = (changed.image[..., 0] > 110) & (changed.image[..., 1:] < 60).all(axis=-1)
    columns, rows = np.flatnonzero(red.sum(axis=0) > 5), np.flatnonzero(red.sum(axis=1) > 5)
    np.testing.assert_allclose(changed.boxes[0], [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], atol=2)


def test_anchors_at_an_object_point_at_its_box_and_the_rest_is_background() -> None:
    box = (100.0, 80.0, 150.0, 120.0)
    targets = anchor_targets(example(box))
    positive = targets.objectness == 1
    assert 1 <= positive.sum() < 10 and ((targets.objectness == 0) | positive).all()
    reached = apply_offsets(anchor_boxes()[positive], targets.offsets[positive])
    torch.testing.assert_close(reached, torch.tensor([box]).expand_as(reached), atol=1e-3, rtol=0)


def test_a_small_object_on_a_large_one_gets_anchors_of_its_own() -> None:
    targets = anchor_targets(example((60, 60, 240, 180), (138, 108, 162, 132)))
    reached = apply_offsets(anchor_boxes(), targets.offsets)[targets.objectness == 1].numpy()
    found = intersection_over_union(np.array([(60, 60, 240, 180), (138, 108, 162, 132)], float), reached)
    assert (found.max(axis=1) > 0.99).all()


def test_ignored_objects_are_neither_object_nor_background() -> None:
    targets = anchor_targets(example((100, 80, 150, 120), ignored=True))
    assert set(targets.objectness.tolist()) == {-1.0, 0.0}


def test_regions_hold_both_objects_and_background() -> None:
    truth = example((100, 80, 150, 120))
    proposals = np.array([(102, 80, 150, 120), (0, 0, 40, 40), (200, 100, 260, 180)], float)
    boxes, labels, matched = region_targets(proposals, truth, BACKGROUND, np.random.default_rng(0))
    assert len(boxes) == REGIONS and set(labels) == {3, BACKGROUND}
    overlaps = intersection_over_union(boxes, truth.boxes)[:, 0]
    assert (overlaps[labels == 3] >= 0.5).all() and (overlaps[labels == BACKGROUND] < 0.5).all()
    np.testing.assert_array_equal(matched[labels == 3][0], truth.boxes[0])


def test_an_empty_image_teaches_background_only() -> None:
    boxes, labels, _ = region_targets(np.array([(0.0, 0, 40, 40)]), example(), BACKGROUND, np.random.default_rng(0))
    assert len(boxes) == REGIONS and (labels == BACKGROUND).all()
    assert (anchor_targets(example()).objectness == 0).all()


def test_a_few_steps_lower_the_losses() -> None:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    network = DetectionNetwork(tuple(f"object {i}" for i in range(BACKGROUND))).train()
    batch = [example((100, 80, 150, 120)), example((30, 30, 60, 90), (150, 60, 250, 160))]
    optimiser = torch.optim.AdamW(network.parameters(), 2e-3)
    history: list[torch.Tensor] = []
    for _ in range(8):
        parts = losses(network, batch, rng)
        optimiser.zero_grad()
        parts.sum().backward()
        optimiser.step()
        history.append(parts.detach())
    assert (history[-1][:3] < 0.8 * history[0][:3]).all()


def test_the_learning_rate_rises_then_falls() -> None:
    assert schedule(0.0, 0) < 0.01
    assert schedule(0.05, 300) > 0.98
    assert schedule(0.5, 3000) == pytest.approx(0.505)
    assert schedule(1.0, 6000) == pytest.approx(0.01)
