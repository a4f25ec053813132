"""What goes to the robot's controllers and what its encoders say."""

from typing import Literal

import numpy as np

from runner.contract import Message, Struct
from stages.messages.arrays import Matrix, Vector

Stopped = Literal["", "stop", "slip", "touch", "fault"]
"""Why a command was not carried out to its end: somebody asked, what is held slips, something was in the way, or the
robot itself did not do it."""


LIFTED = 0.15
"""Seconds after which a motion that lifts bears what is lifted."""


class Guard(Struct, frozen=True, kw_only=True):
    """What must hold while a command is carried out; where it does not, the robot brakes at once.

    Guarded motion (Will and Grossman 1975): the robot's own controllers compare what they measure in every cycle.
    """

    narrowest: float = 0.0
    """Metres between the fingertips, at least."""
    widest: float = 1.0
    """Metres between the fingertips, at most."""
    force: float = 1e6
    """Newtons from outside, as if they acted on the hand: motor efforts beyond those that the motion takes."""
    error: float = 0.05
    """Radians (metres) by which a joint may be where it was not commanded to be."""
    load: float = 0.0
    """Newtons that must have been felt from outside, since the fingers last moved, by the time that what is lifted is
    borne."""

    def broken(self, *, opening: float, force: float, error: float, seconds: float = 0.0) -> tuple[Stopped, str] | None:
        """Which of it does not hold for what is measured, ``seconds`` after the motion began, and what that is; None
        where all does."""
        if not self.narrowest <= opening <= self.widest:
            return "slip", f"the fingers are {1e3 * opening:.0f} mm apart"
        if seconds > LIFTED and force < self.load:
            return "slip", f"nothing weighs on the hand ({force:.1f} N)"
        if force > self.force:
            return "touch", f"{force:.0f} N at the hand"
        if error > self.error:
            return "touch", f"a joint is {np.rad2deg(error):.1f} degrees off"
        return None


class RobotCommand(Message, frozen=True, kw_only=True):
    """A joint trajectory to follow, then a gripper opening to reach; either may be empty."""

    joint_names: tuple[str, ...] = ()
    times: Vector
    """Seconds from the start of the motion, length T."""
    positions: Matrix
    """T x J, radians (metres for the torso)."""
    velocities: Matrix
    gripper_width: float | None = None
    """Metres between the fingertips."""
    label: str = ""
    """What the motion is for, shown to people."""
    guard: Guard | None = None
    """Not watched where None."""


class Brake(Message, frozen=True, kw_only=True):
    """Has a command that is under way come to a stand at once."""


class RobotState(Message, frozen=True, kw_only=True):
    """Encoders after a command has ended or the world was arranged."""

    joint_names: tuple[str, ...]
    positions: Vector
    gripper_width: float
    time: float
    """Robot clock, seconds."""
    tracking_error: float = 0.0
    """Largest joint error while the last trajectory ran, radians."""
    stopped: Stopped = ""
    reason: str = ""
    """What was measured where it stopped."""
    force: float = 0.0
    """Largest force from outside that was felt while the last command ran, as if it acted on the hand, newtons."""
    shown: bool = False
    """Nothing moves: commands are only shown, and ``reason`` says why."""
