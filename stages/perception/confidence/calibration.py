"""Costs and evidence into probabilities.

Raw weights exp(-lambda d) are far too sharp: neighbouring readings err together, and the sensor's and the model's
biases are in no likelihood. Costs become log-odds ("nats") through scales, and evidence becomes a probability through
a logistic model, that ``python -m benchmarks.calibration`` fits on rendered scenes of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import yaml

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.perception.filter.likelihood import CostForm, ObservedScene

RIGHT_METRES = 0.02
RIGHT_RADIANS = np.deg2rad(15.0)
"""A pose within these of the truth, modulo the object's symmetries, is right."""
FEATURES = (
    "margin", "fit", "shown", "gain", "looked through", "spread", "hypothesis", "confidence", "unexplained", "sunk",
    "penetration",
)  # fmt: skip
"""What a probability is made of; :func:`Evidence.features`."""
CONSTANTS = Path(__file__).with_name("calibration.yaml")
_FARTHEST = 3.0


@dataclass(frozen=True)
class Calibration:
    """Constants that turn costs and evidence into probabilities."""

    hypothesis_scale: float
    """Objects left unexplained by which scenes must differ for one nat."""
    pose_scale: float
    """Readings that count as one independent reading when poses of an object are compared."""
    spread_scale: float
    """Factor from the spread of the tempered likelihood to that of the errors."""
    bias: float
    weights: tuple[float, ...]
    """One per feature."""
    centres: tuple[float, ...]
    scales: tuple[float, ...]
    """Mean and deviation by which each feature is standardised."""

    @staticmethod
    @cache
    def load(path: Path = CONSTANTS) -> Calibration:
        """Reads the constants that the benchmark wrote.

        Raises:
            Refused: the file is not of that form; names file and key.
        """
        try:
            found = msgspec.convert(yaml.safe_load(path.read_text()), Calibration)
        except (OSError, yaml.YAMLError, msgspec.ValidationError) as error:
            raise Refused(f"{path}: {error}; `python -m benchmarks.calibration` writes this file") from None
        for key in ("weights", "centres", "scales"):
            if len(getattr(found, key)) != len(FEATURES):
                raise Refused(
                    f"{path}: {key} has {len(getattr(found, key))} numbers; there are {len(FEATURES)} features"
                )
        return found

    def probability(self, features: Floats) -> float:
        """That a pose with these features is right."""
        standard = standardised(features, np.array(self.centres), np.array(self.scales))
        return float(1.0 / (1.0 + np.exp(-(self.bias + (standard * np.array(self.weights)).sum()))))


def standardised(features: Floats, centres: Floats, scales: Floats) -> Floats:
    """Features in deviations from their mean; bounded, so that a model never reaches far beyond what it has seen.

    The margin, which comes first, has bounds of its own.
    """
    bounds = np.append(np.inf, np.full(len(FEATURES) - 1, _FARTHEST))
    return np.clip((features - centres) / scales, -bounds, bounds)


def cost_of_an_object(scene: ObservedScene, objects: int) -> float:
    """What it costs to leave an object of ordinary size in the image unexplained, metres times pixels.

    Costs of scenes are compared in these, so that neither the image's resolution nor the objects' size matters.
    """
    return CostForm().truncation * max(1.0, float(scene.foreground.sum()) / max(1, objects))


def hypothesis_probabilities(log_weights: Floats, nat: float) -> Floats:
    """Probability of each hypothesis, summing to 1; ``nat`` is the difference of log-weights that is one nat.

    ``log_weights`` are minus the costs of equation 9, metres times pixels.
    """
    weights = np.exp((log_weights - log_weights.max()) / nat)
    return weights / weights.sum()
