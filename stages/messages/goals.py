"""Goals that are kept on disk, and what people ask of them."""

from typing import Literal

from runner.contract import Command, Message
from stages.messages.task import Goal


class Kept(Message, frozen=True, kw_only=True):
    """All goals that are on disk, by name."""

    goals: tuple[Goal, ...]
    faults: tuple[str, ...] = ()
    """Folders beside them that hold none or could not be written, and why."""


class Forget(Command, frozen=True, kw_only=True):
    """Deletes the goal of that name."""

    answers = (Kept,)

    name: str
    """Of a goal that is kept."""


class Rename(Command, frozen=True, kw_only=True):
    """Gives a goal another name."""

    answers = (Kept,)

    name: str
    """Of a goal that is kept."""
    to: str
    """Letters, digits, - and _; no goal may have it."""


class Strike(Command, frozen=True, kw_only=True):
    """Strikes out what does not matter for a goal."""

    answers = (Kept,)

    name: str
    """Of a goal that is kept."""
    what: str
    """An object, for example cup; or one of the goal's relations, for example in(cup, tray)."""


class Loosen(Command, frozen=True, kw_only=True):
    """Says how far from where it was shown an object may stand and still be next to the other."""

    answers = (Kept,)

    name: str
    """Of a goal that is kept."""
    region: str
    """Of the goal, for example cup_near_tray."""
    radius: float
    """Metres."""


class Face(Command, frozen=True, kw_only=True):
    """Says which side an object of a goal has to show."""

    answers = (Kept,)

    name: str
    """Of a goal that is kept."""
    object: str
    """Of the goal; the picture must tell its sides apart."""
    side: Literal["any", "shown", "left", "back", "right"]
    """``any`` for whichever; as it was shown; or turned from that: a quarter to the left, half, a quarter to the
    right, seen from above."""


class Add(Command, frozen=True, kw_only=True):
    """Adds a goal that was exported, here or by another robot."""

    answers = (Kept,)

    file: bytes
    """What was exported, as base64."""
    name: str = ""
    """The one it was exported under by default. No goal may have it."""
