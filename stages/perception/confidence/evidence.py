"""What an image says of the pose of one object: what is asked, and what is answered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.geometry.arrays import Floats
from stages.perception.confidence.calibration import RIGHT_METRES

ORDINARY_NOISE = 0.00125
"""Metres; where the plane shows too little to tell."""
_DEEPEST = 0.04
"""Metres in the plane or in another object from which on an object lies as wrong as can be."""
CAP = 12.0
"""Nats beyond which evidence is as good as any."""


@dataclass(frozen=True)
class Rival:
    """A pose that depth found nearly equal to the estimate."""

    T_camera_object: Floats
    """3 x 4."""
    nats: float
    """Log-odds of the estimate against it."""


@dataclass(frozen=True)
class Judged:
    """An object of the winning scene whose pose is to be judged."""

    label: str
    T_camera_object: Floats
    """3 x 4 or 4 x 4."""
    confidence: float
    """The detector's."""
    rivals: tuple[Rival, ...] = ()
    """Other poses that the estimator considered."""
    box: Floats | None = None
    """The detector's, x0, y0, x1, y1 in pixels; None where there was none."""
    sunk: float = 0.0
    """How far its lowest point lies below the plane, metres."""
    penetration: float = 0.0
    """How deep it and another object reach into each other, metres."""


@dataclass(frozen=True)
class Evidence:
    """What the image says of one object's pose."""

    margin: float
    """Log-odds of the estimate, and all that counts as the same, against all other poses that were compared."""
    fit: float
    """Mean distance over the pixels that show it, metres, bounded."""
    shown: float
    """Readings that show it, at the common detail."""
    visible: float
    """Share of the silhouette that nothing hides."""
    gain: float
    """Mean cost per shown reading that the object saves, as a share of the bound; below 0 where it costs."""
    looked_through: float
    spread_metres: float
    spread_radians: float
    breadth: float
    """Spread of the tempered likelihood relative to what counts as right, before it is scaled to that of the errors."""
    hypothesis: float
    """Probability of the scene's hypothesis."""
    confidence: float
    sunk: float = 0.0
    """How far its lowest point lies below the plane, metres."""
    penetration: float = 0.0
    """How deep it and another object reach into each other, metres."""
    unexplained: float = 0.0
    """Share of the foreground readings in its box that no object of the scene explains."""
    noise: float = ORDINARY_NOISE
    """How far readings of the plane lie from it, metres."""

    def features(self) -> Floats:
        """The numbers that :data:`calibration.FEATURES` names."""
        odds = np.clip(self.hypothesis, 1e-4, 1 - 1e-4)
        return np.array([
            np.clip(self.margin, -CAP, CAP),
            np.log(max(self.fit, 5e-4) / self.noise),
            np.log(max(self.shown, 10.0)),
            np.clip(self.gain, -1.0, 1.0),
            self.looked_through,
            np.log(np.clip(self.breadth, 1e-2, 10.0)),
            np.log(odds / (1 - odds)),
            self.confidence,
            self.unexplained,
            min(self.sunk, _DEEPEST) / RIGHT_METRES,
            min(self.penetration, _DEEPEST) / RIGHT_METRES,
        ])  # fmt: skip


@dataclass(frozen=True)
class Others:
    """Poses that explain the image about as well as the estimate."""

    poses: Floats
    """A x 3 x 4, likeliest first."""
    weights: Floats
    """Of each, relative to the estimate's own."""
