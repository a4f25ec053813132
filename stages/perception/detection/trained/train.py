"""Trains the network: ``python -m stages.perception.detection.trained.train TRAIN.npz WEIGHTS.safetensors``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from stages.perception.detection.boxes import intersection_over_union
from stages.perception.detection.trained.network import (
    ANCHOR_SIZES,
    HEIGHT,
    STRIDE,
    WIDTH,
    DetectionNetwork,
    anchor_boxes,
    normalised,
)
from stages.perception.detection.trained.offsets import encode_offsets
from stages.perception.detection.trained.training_images import Example, load_examples

REGIONS = 48
"""Regions per image that the second stage learns from."""
_FOREGROUND = 20  # At most so many of them are objects.
_IGNORED = -1


@dataclass(frozen=True)
class Settings:
    """How long and how hard to train."""

    seconds: float = 2100.0
    batch: int = 6
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    seed: int = 0


@dataclass(frozen=True)
class AnchorTargets:
    """What the proposal head should say about one image's anchors."""

    objectness: Tensor
    """A: 1 object, 0 background, -1 does not matter."""
    offsets: Tensor
    """A x 4, meaningful where objectness is 1."""


def augmented(example: Example, rng: np.random.Generator) -> Example:
    """The example mirrored, scaled, shifted and with other colours; boxes that leave the image are ignored."""
    matrix, mirror = _random_view(rng)
    image = cv2.warpAffine(example.image, matrix, (WIDTH, HEIGHT), borderValue=rng.uniform(0, 255, 3).tolist())
    gain = rng.uniform(0.85, 1.15) * rng.normal(1, 0.03, 3)
    image = np.clip(image * gain + rng.normal(0, 6), 0, 255).astype(np.uint8)
    corners = example.boxes.reshape(-1, 2, 2) * np.diag(matrix[:, :2]) + matrix[:, 2]
    if mirror:
        corners[..., 0] = corners[:, ::-1, 0]
    whole = corners.reshape(-1, 4)
    boxes = np.clip(whole, 0, [WIDTH, HEIGHT, WIDTH, HEIGHT])
    sizes, whole_sizes = boxes[:, 2:] - boxes[:, :2], whole[:, 2:] - whole[:, :2]
    left = sizes.prod(axis=1) / np.maximum(whole_sizes.prod(axis=1), 1e-9)
    inside = (sizes > 1).all(axis=1)
    ignored = example.ignored | (left < 0.5) | (sizes.min(axis=1, initial=np.inf) < 5)
    return Example(image, boxes[inside], example.labels[inside], ignored[inside])


def _random_view(rng: np.random.Generator) -> tuple[NDArray[np.float64], bool]:
    """A 2 x 3 affine map: scale 0.8 to 1.3, shift, mirrored in half the cases."""
    scale = np.exp(rng.uniform(np.log(0.8), np.log(1.3)))
    shift = rng.uniform(-0.12, 0.12, 2) * (WIDTH, HEIGHT) + (1 - scale) / 2 * np.array([WIDTH, HEIGHT])
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    mirror = bool(rng.random() < 0.5)
    if mirror:
        matrix[0] = -matrix[0]
        matrix[0, 2] += WIDTH
    return matrix, mirror


def anchor_targets(example: Example) -> AnchorTargets:
    """Anchors near an object's centre and of its size are positive; within ignored objects none counts."""
    anchors = anchor_boxes().numpy().astype(np.float64)
    centres = (anchors[:, :2] + anchors[:, 2:]) / 2
    middles = (example.boxes[:, :2] + example.boxes[:, 2:]) / 2
    sizes = np.sqrt(np.prod(example.boxes[:, 2:] - example.boxes[:, :2], axis=1))
    away = np.abs(centres[:, None] - middles[None]).max(axis=-1) / np.maximum(STRIDE, 0.15 * sizes)
    fits = _size_slots(sizes)[np.arange(len(anchors)) % len(ANCHOR_SIZES)]
    away = np.where(fits, away, np.inf)
    objectness = np.zeros(len(anchors))
    offsets = torch.zeros(len(anchors), 4)
    if len(sizes):
        nearest = away.argmin(axis=1)
        near = away.min(axis=1) <= 1.0
        objectness[near] = np.where(example.ignored[nearest[near]], _IGNORED, 1)
        boxes = torch.from_numpy(example.boxes[nearest[near]])
        offsets[torch.from_numpy(near)] = encode_offsets(torch.from_numpy(anchors[near]), boxes).float()
    return AnchorTargets(torch.from_numpy(objectness), offsets)


def _size_slots(sizes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which anchor sizes may find which object: the nearest one, and the next where it is nearly as near; 3 x N."""
    distance = np.abs(np.log(sizes[None] / np.array(ANCHOR_SIZES)[:, None]))
    return distance <= distance.min(axis=0, initial=np.inf) + 0.2


def region_targets(
    proposals: NDArray[np.float64], example: Example, background: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Draws REGIONS boxes for the second stage: boxes R x 4, labels R (-1 ignored), the true box of each R x 4."""
    true = np.repeat(example.boxes, 4, axis=0)
    size = np.tile(true[:, 2:] - true[:, :2], 2)
    jittered = true + rng.normal(0, 0.1, true.shape) * size
    boxes = _clipped(np.concatenate([proposals, jittered]))
    overlaps = intersection_over_union(boxes, example.boxes)
    best = overlaps.max(axis=1, initial=0.0)
    owner = overlaps.argmax(axis=1) if len(example.labels) else np.zeros(len(boxes), np.int64)
    labels = np.full(len(boxes), background)
    if len(example.labels):
        hit = best >= 0.5
        labels[hit] = example.labels[owner[hit]]
        labels[(best >= 0.3) & example.ignored[owner]] = _IGNORED
    chosen = _balanced(labels, background, rng)
    matched = example.boxes[owner[chosen]] if len(example.labels) else boxes[chosen]
    return boxes[chosen], labels[chosen], matched


def _balanced(labels: NDArray[np.int64], background: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """REGIONS indices: up to _FOREGROUND objects, the rest background, repeated where there are too few."""
    objects = rng.permutation(np.flatnonzero((labels >= 0) & (labels != background)))[:_FOREGROUND]
    others = rng.permutation(np.flatnonzero(labels == background))[: REGIONS - len(objects)]
    chosen = np.concatenate([objects, others])
    if not len(chosen):
        return np.zeros(REGIONS, np.int64)
    return np.resize(chosen, REGIONS)


def _clipped(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    low = np.clip(boxes[:, :2], 0, [WIDTH - 1, HEIGHT - 1])
    return np.concatenate([low, np.maximum(np.clip(boxes[:, 2:], 0, [WIDTH, HEIGHT]), low + 1)], axis=1)


def losses(network: DetectionNetwork, batch: Sequence[Example], rng: np.random.Generator) -> Tensor:
    """The four losses of a batch: objectness, proposal offsets, labels, region offsets."""
    images = normalised(np.stack([example.image for example in batch]))
    with torch.autocast("cpu", torch.bfloat16):
        fine, coarse = network.backbone(images)
        logits, offsets = network.proposals(coarse)
    logits, offsets = logits.float(), offsets.float()
    first = _proposal_losses(logits, offsets, [anchor_targets(example) for example in batch])
    drawn = [_drawn(network, logits[i], offsets[i], example, rng) for i, example in enumerate(batch)]
    boxes, labels, matched = (np.stack(parts) for parts in zip(*drawn, strict=True))
    with torch.autocast("cpu", torch.bfloat16):
        label_logits, refinements = network.classify(fine, torch.from_numpy(boxes).float())
    second = _region_losses(label_logits.float(), refinements.float(), boxes, labels, matched)
    return torch.stack([*first, *second])


def _drawn(
    network: DetectionNetwork, logits: Tensor, offsets: Tensor, example: Example, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    proposals = network.propose(logits.detach(), offsets.detach(), keep=64).double().numpy()
    return region_targets(proposals, example, len(network.labels), rng)


def _proposal_losses(logits: Tensor, offsets: Tensor, targets: Sequence[AnchorTargets]) -> tuple[Tensor, Tensor]:
    """Focal loss (Lin et al. 2017) on objectness, smooth L1 on offsets, per positive anchor."""
    objectness = torch.stack([target.objectness for target in targets])
    positive = objectness == 1
    count = positive.sum().clamp(min=1)
    truth = positive.float()
    entropy = functional.binary_cross_entropy_with_logits(logits, truth, reduction="none")
    missed = (truth - logits.sigmoid()).abs()
    weight = missed**2 * (0.25 * truth + 0.75 * (1 - truth)) * (objectness >= 0)
    wanted = torch.stack([target.offsets for target in targets])
    distance = functional.smooth_l1_loss(offsets[positive], wanted[positive], beta=0.1, reduction="sum")
    return (weight * entropy).sum() / count * 4, distance / count


def _region_losses(
    logits: Tensor,
    refinements: Tensor,
    boxes: NDArray[np.float64],
    labels: NDArray[np.int64],
    matched: NDArray[np.float64],
) -> tuple[Tensor, Tensor]:
    """Cross entropy on labels, smooth L1 on the offsets of the objects."""
    truth = torch.from_numpy(labels.reshape(-1))
    entropy = functional.cross_entropy(logits, truth, ignore_index=_IGNORED)
    wanted = encode_offsets(*(torch.from_numpy(part.reshape(-1, 4)).float() for part in (boxes, matched)))
    objects = (truth >= 0) & (truth < logits.shape[1] - 1)
    distance = functional.smooth_l1_loss(refinements[objects], wanted[objects], beta=0.05, reduction="sum")
    return entropy, distance / objects.sum().clamp(min=1)


def batches(examples: Sequence[Example], settings: Settings, rng: np.random.Generator) -> Iterator[list[Example]]:
    """Augmented batches without end, every example once per round."""
    while True:
        order = rng.permutation(len(examples))
        for start in range(0, len(order) - settings.batch + 1, settings.batch):
            yield [augmented(examples[i], rng) for i in order[start : start + settings.batch]]


def train(network: DetectionNetwork, examples: Sequence[Example], settings: Settings, save_to: Path) -> None:
    """Trains for a while, prints a line a minute, and writes the weights: averaged over the last steps."""
    rng = np.random.default_rng(settings.seed)
    optimiser = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    # The mean of the last few hundred steps is better than the last step (Polyak averaging).
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(0.998), use_buffers=True)
    begin = shown = time.monotonic()
    recent: list[Tensor] = []
    for step, batch in enumerate(batches(examples, settings, rng)):
        share = (time.monotonic() - begin) / settings.seconds
        if share >= 1:
            break
        optimiser.param_groups[0]["lr"] = settings.learning_rate * schedule(share, step)
        parts = losses(network, batch, rng)
        optimiser.zero_grad()
        parts.sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        average.update_parameters(network)
        recent.append(parts.detach())
        if time.monotonic() - shown > 60:
            shown = time.monotonic()
            means = " ".join(f"{value:.3f}" for value in torch.stack(recent).mean(0).tolist())
            print(f"{shown - begin:6.0f} s  step {step}  objectness offsets labels offsets: {means}", flush=True)
            recent.clear()
            _averaged(average).save(save_to)
    _averaged(average).save(save_to)


def _averaged(average: AveragedModel) -> DetectionNetwork:
    assert isinstance(average.module, DetectionNetwork)
    return average.module


def schedule(share: float, step: int) -> float:
    """Factor of the learning rate: linear over the first 200 steps, then half a cosine down to 1 %."""
    return min(1.0, (step + 1) / 200) * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * share)))


def main() -> None:
    """Reads the command line and trains."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("examples", type=Path, nargs="+", help="npz files of stages.devices.detector_data")
    parser.add_argument("weights", type=Path, help="safetensors file to write")
    parser.add_argument("--minutes", type=float, default=35.0)
    parser.add_argument("--learning-rate", type=float, default=2e-3)
    parser.add_argument("--batch", type=int, default=6)
    parser.add_argument("--start-from", type=Path, help="weights to continue from")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    loaded = [load_examples(path) for path in arguments.examples]
    examples = [example for part, _ in loaded for example in part]
    network = DetectionNetwork.load(arguments.start_from) if arguments.start_from else DetectionNetwork(loaded[0][1])
    network.train()
    settings = Settings(seconds=60 * arguments.minutes, batch=arguments.batch, learning_rate=arguments.learning_rate)
    train(network, examples, settings, arguments.weights)


if __name__ == "__main__":
    main()
