"""What a calibration must be to be believed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What a calibration must be to be believed."""

    boards: int = 6
    """Pictures in which the board was found, at least."""
    turn: float = 12.0
    """Degrees by which boards are turned against each other, root mean square, about each of two axes."""
    residual: float = 1.0
    """Pixels by which corners are off, root mean square."""
    millimetres: float = 2.0
    degrees: float = 0.2
    """By which the camera's place may be uncertain; a board may be as many millimetres, in the median, from where all
    other pictures have it."""
