"""What the network says of a box: how far it lies beside another one, and how much larger it is."""

from __future__ import annotations

import torch
from torch import Tensor


def encode_offsets(anchors: Tensor, boxes: Tensor) -> Tensor:
    """Shift and log scale that take each anchor to its box (R-CNN, Girshick et al. 2014, appendix C); N x 4."""
    size = anchors[:, 2:] - anchors[:, :2]
    shift = (boxes[:, :2] + boxes[:, 2:] - anchors[:, :2] - anchors[:, 2:]) / 2 / size
    scale = torch.log((boxes[:, 2:] - boxes[:, :2]) / size)
    return torch.cat([shift, scale], dim=1)


def apply_offsets(anchors: Tensor, offsets: Tensor) -> Tensor:
    """The inverse of :func:`encode_offsets`; scales are limited to a factor of 4."""
    size = anchors[:, 2:] - anchors[:, :2]
    centre = (anchors[:, :2] + anchors[:, 2:]) / 2 + offsets[:, :2] * size
    half = size * torch.exp(offsets[:, 2:].clamp(-1.386, 1.386)) / 2
    return torch.cat([centre - half, centre + half], dim=1)
