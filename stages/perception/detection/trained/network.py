"""A small two-stage object detector: convolutional features, region proposals, RoI-align, classification.

The design is Faster R-CNN's (Ren et al. 2015) with RoI-align (He et al. 2017), cut down to run on one CPU
core: a plain backbone, one proposal level with three square anchors per cell and a class-agnostic box.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from runner.contract import Refused
from stages.perception.detection.boxes import suppress
from stages.perception.detection.trained.offsets import apply_offsets

WIDTH, HEIGHT = 320, 240
"""Images are scaled to fit this size; boxes inside the network are in its pixels."""
STRIDE = 8
ANCHOR_SIZES = (20.0, 44.0, 100.0)
ROI_CELLS = 7


@dataclass(frozen=True)
class Detections:
    """Boxes of one image, best first, with the confidence of every label for each."""

    boxes: NDArray[np.float64]
    """N x 4: x0, y0, x1, y1 in pixels of the image."""
    confidences: NDArray[np.float64]
    """N x L softmax probabilities; a row falls short of 1 by the probability of background."""

    @property
    def scores(self) -> NDArray[np.float64]:
        """Confidence of each box's best label, N."""
        return self.confidences.max(axis=1, initial=0.0)


class _Convolution(nn.Sequential):
    """3 x 3 convolution, batch normalisation, ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        super().__init__(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class Backbone(nn.Module):
    """Image to two feature maps: fine (1/4, for RoI-align) and coarse (1/8, for proposals), both top-down merged."""

    FINE, COARSE = 64, 96

    def __init__(self) -> None:
        super().__init__()
        self.quarter = nn.Sequential(_Convolution(3, 24, 2), _Convolution(24, 48, 2), _Convolution(48, 48))
        self.eighth = nn.Sequential(_Convolution(48, 96, 2), *(_Convolution(96, 96) for _ in range(3)))
        self.sixteenth = nn.Sequential(_Convolution(96, 160, 2), *(_Convolution(160, 160) for _ in range(3)))
        self.down = nn.Conv2d(160, self.COARSE, 1)
        self.coarse = nn.Conv2d(96, self.COARSE, 1)
        self.middle = nn.Conv2d(self.COARSE, self.FINE, 1)
        self.fine = nn.Conv2d(48, self.FINE, 1)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """B x 3 x H x W to (B x 64 x H/4 x W/4, B x 96 x H/8 x W/8)."""
        quarter = self.quarter(images)
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        coarse = self.coarse(eighth) + _twice(self.down(sixteenth))
        fine = self.fine(quarter) + _twice(self.middle(coarse))
        return functional.relu(fine), functional.relu(coarse)


class ProposalHead(nn.Module):
    """Objectness and box offsets of every anchor."""

    def __init__(self) -> None:
        super().__init__()
        self.shared = _Convolution(Backbone.COARSE, 96)
        self.objectness = nn.Conv2d(96, len(ANCHOR_SIZES), 1)
        self.offsets = nn.Conv2d(96, 4 * len(ANCHOR_SIZES), 1)
        nn.init.constant_(_bias(self.objectness), -4.0)  # Nearly all anchors are background (Lin et al. 2017).

    def forward(self, coarse: Tensor) -> tuple[Tensor, Tensor]:
        """B x C x h x w to logits B x A and offsets B x A x 4; A runs over rows, columns, sizes."""
        shared = self.shared(coarse)
        logits = self.objectness(shared).permute(0, 2, 3, 1).flatten(1)
        return logits, self.offsets(shared).permute(0, 2, 3, 1).reshape(len(coarse), -1, 4)


class RegionHead(nn.Module):
    """Label logits (the last one is background) and box offsets of regions."""

    def __init__(self, labels: int) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Flatten(),
            nn.Linear(Backbone.FINE * ROI_CELLS**2, 256),
            nn.ReLU(inplace=True),
            nn.Linear(256, 256),
            nn.ReLU(inplace=True),
        )
        self.labels = nn.Linear(256, labels + 1)
        self.offsets = nn.Linear(256, 4)

    def forward(self, regions: Tensor) -> tuple[Tensor, Tensor]:
        """N x C x 7 x 7 to N x (L + 1) and N x 4."""
        features = self.features(regions)
        return self.labels(features), self.offsets(features)


class DetectionNetwork(nn.Module):
    """Backbone, proposals and regions together, for images of WIDTH x HEIGHT."""

    def __init__(self, labels: tuple[str, ...]) -> None:
        super().__init__()
        self.labels = labels
        self.backbone = Backbone()
        self.proposals = ProposalHead()
        self.regions = RegionHead(len(labels))
        self.register_buffer("anchors", anchor_boxes(), persistent=False)

    def propose(self, logits: Tensor, offsets: Tensor, *, keep: int) -> Tensor:
        """The most object-like boxes of one image (A and A x 4) after suppression; N x 4 with N <= keep."""
        scores, order = logits.float().topk(4 * keep)
        boxes = clip(apply_offsets(self.get_buffer("anchors")[order], offsets[order].float()))
        kept = suppress(_numpy(boxes), _numpy(scores), 0.7)[:keep]
        return boxes[kept]

    def classify(self, fine: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
        """Label logits and offsets of B x R boxes on B fine feature maps; (B R) x (L + 1) and (B R) x 4."""
        return self.regions(roi_align(fine, boxes, cells=ROI_CELLS, stride=4))

    def save(self, path: Path) -> None:
        """Writes the weights as safetensors in half precision, with the labels in the metadata."""
        tensors = {name: _stored(tensor) for name, tensor in self.state_dict().items()}
        save_file(tensors, path, metadata={"labels": json.dumps(self.labels)})

    @staticmethod
    def load(path: Path) -> DetectionNetwork:
        """Reads what :meth:`save` wrote. Raises :class:`Refused` when the file is not such weights."""
        try:
            with safe_open(path, framework="pt") as file:
                network = DetectionNetwork(tuple(json.loads((file.metadata() or {})["labels"])))
                network.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        except (OSError, SafetensorError, KeyError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise Refused(f"{path}: not the weights of this detection network ({reason})") from None
        return network.eval()


@torch.inference_mode()
def detect(
    network: DetectionNetwork,
    rgb: NDArray[np.uint8],
    *,
    threshold: float,
    keep: int,
    labels: Sequence[int] | None = None,
) -> Detections:
    """The ``keep`` best objects of an H x W x 3 image whose best label reaches ``threshold``.

    ``labels`` restricts the confidences to those columns, in that order. Suppression is strict within a label
    and lenient between labels: two objects may overlap strongly (a can in front of a box), but two boxes of one
    label that do are the same object.
    """
    image, scale = fit(rgb)
    fine, coarse = network.backbone(normalised(image[None]))
    logits, offsets = network.proposals(coarse)
    proposals = network.propose(logits[0], offsets[0], keep=64)
    label_logits, refinements = network.classify(fine, proposals[None])
    boxes = _numpy(clip(apply_offsets(proposals, refinements), width=rgb.shape[1] * scale, height=rgb.shape[0] * scale))
    confidences = _numpy(functional.softmax(label_logits.double(), dim=1))[:, :-1]
    confidences = confidences if labels is None else confidences[:, labels]
    best = confidences.max(axis=1)
    kept = [i for i in suppress(boxes, best, 0.8) if best[i] >= threshold]
    kept = [kept[i] for i in suppress(boxes[kept], best[kept], 0.4, labels=confidences[kept].argmax(axis=1))]
    return Detections(boxes[kept[:keep]] / scale, confidences[kept[:keep]])


def fit(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """The image scaled to fit HEIGHT x WIDTH (the rest is black) and the scale."""
    scale = min(WIDTH / rgb.shape[1], HEIGHT / rgb.shape[0])
    size = round(rgb.shape[1] * scale), round(rgb.shape[0] * scale)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[: size[1], : size[0]] = cv2.resize(np.ascontiguousarray(rgb), size, interpolation=cv2.INTER_AREA)
    return image, scale


def normalised(images: NDArray[np.uint8]) -> Tensor:
    """B x H x W x 3 bytes to B x 3 x H x W, about -1 to 1, channels last in memory."""
    values = torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2)
    return values.float().sub(127.0).div(64.0).contiguous(memory_format=torch.channels_last)


def anchor_boxes() -> Tensor:
    """Square boxes centred on every coarse cell, A x 4, in the order of :class:`ProposalHead`'s outputs."""
    y, x, size = torch.meshgrid(
        (torch.arange(HEIGHT // STRIDE) + 0.5) * STRIDE,
        (torch.arange(WIDTH // STRIDE) + 0.5) * STRIDE,
        torch.tensor(ANCHOR_SIZES),
        indexing="ij",
    )
    return torch.stack([x - size / 2, y - size / 2, x + size / 2, y + size / 2], dim=-1).reshape(-1, 4)


def roi_align(features: Tensor, boxes: Tensor, *, cells: int, stride: int) -> Tensor:
    """Features inside boxes on a regular grid, each cell the mean of 2 x 2 bilinear samples (He et al. 2017).

    ``features`` B x C x h x w, ``boxes`` B x R x 4 in image pixels; result (B R) x C x cells x cells.
    """
    count, channels, height, width = features.shape
    steps = (torch.arange(2 * cells, dtype=boxes.dtype) + 0.5) / (2 * cells)
    x = boxes[..., 0:1] + (boxes[..., 2:3] - boxes[..., 0:1]) * steps
    y = boxes[..., 1:2] + (boxes[..., 3:4] - boxes[..., 1:2]) * steps
    # grid_sample's -1 and 1 are the outer edges of the map, as box coordinates are of the image.
    x = x / (width * stride) * 2 - 1
    y = y / (height * stride) * 2 - 1
    shape = (*boxes.shape[:2], 2 * cells, 2 * cells)
    grid = torch.stack([x[:, :, None, :].expand(shape), y[:, :, :, None].expand(shape)], dim=-1)
    samples = functional.grid_sample(features.float(), grid.flatten(1, 2), padding_mode="border", align_corners=False)
    samples = samples.reshape(count, channels, -1, 2 * cells, 2 * cells).transpose(1, 2).flatten(0, 1)
    return functional.avg_pool2d(samples, 2)


def clip(boxes: Tensor, *, width: float = WIDTH, height: float = HEIGHT) -> Tensor:
    """Boxes cut at the edge of an image so wide and high, at least one pixel wide and high; N x 4."""
    limits = torch.tensor([width, height], dtype=boxes.dtype)
    low = torch.minimum(boxes[:, :2].clamp(min=0.0), limits - 1)
    return torch.cat([low, torch.maximum(torch.minimum(boxes[:, 2:], limits), low + 1)], dim=1)


def _stored(tensor: Tensor) -> Tensor:
    return (tensor.half() if tensor.is_floating_point() else tensor).contiguous()


def _twice(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2.0, mode="nearest")


def _bias(convolution: nn.Conv2d) -> Tensor:
    assert convolution.bias is not None
    return convolution.bias


def _numpy(tensor: Tensor) -> NDArray[np.float64]:
    return tensor.detach().double().numpy()
