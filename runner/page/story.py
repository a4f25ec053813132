"""What a page tells a person who does not program, in neutral terms; how it is shown is the page's matter.

A graph file names a class (``story: stages.story:Story``) that turns messages into what is told; it is the
:class:`Story` protocol below. What it tells are values and knows nothing of the page. Texts are in the language that is
asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from runner.contract import Message
from runner.graph.graph import Graph

Language = Literal["en", "de"]
Surety = Literal["sure", "unsure", "doubtful", "unknown"]
"""``sure`` can be relied on, ``unsure`` had better be looked at, ``doubtful`` is probably wrong, ``unknown`` is there
and nobody knows what it is."""


@dataclass(frozen=True, slots=True)
class Photo:
    """A picture; equal keys are equal pictures."""

    key: str
    """Letters, digits, ``.``, ``-`` and ``_``."""
    rgb: NDArray[np.uint8]
    """H x W x 3."""


@dataclass(frozen=True, slots=True)
class File:
    """Something to be downloaded; equal keys are equal files."""

    key: str
    """Letters, digits, ``.``, ``-`` and ``_``."""
    name: str
    label: str
    data: NDArray[np.uint8]
    """N bytes."""


@dataclass(frozen=True, slots=True)
class Outline:
    """Something seen in a picture."""

    name: str
    """By which statements refer to it."""
    label: str
    surety: Surety
    how_sure: str
    """In words."""
    points: tuple[tuple[int, int], ...]
    """Its edge, x and y in pixels."""


@dataclass(frozen=True, slots=True)
class Arrow:
    """Something that will be moved in a picture; from and to as x and y in pixels."""

    label: str
    start: tuple[int, int]
    end: tuple[int, int]


@dataclass(frozen=True, slots=True)
class View:
    """The newest picture with what was seen in it."""

    photo: Photo
    caption: str
    outlines: tuple[Outline, ...] = ()
    arrows: tuple[Arrow, ...] = ()
    """In the order in which things will be moved."""


@dataclass(frozen=True, slots=True)
class Tie:
    """An edge of the scene's graph: something is carried by another thing, or is beside it."""

    kind: Literal["carried", "beside"]
    how: str
    """In words, for example "on"."""
    other: str
    """What another statement is about; what no statement is about carries everything."""
    label: str
    """The name of the other."""


@dataclass(frozen=True, slots=True)
class Statement:
    """One sentence about the scene; ``about`` names an outline, or is empty."""

    text: str
    about: str = ""
    surety: Surety = "sure"
    how_sure: str = ""
    label: str = ""
    """The name of what it is about."""
    ties: tuple[Tie, ...] = ()
    """What the sentence says, as edges of a graph."""


@dataclass(frozen=True, slots=True)
class Ask:
    """A field of a command that the person fills in."""

    field: str
    label: str
    hint: str = ""
    pattern: str = ""
    """Regular expression that the whole text must match; anything by default."""
    kind: Literal["text", "file", "choice"] = "text"
    """A file is sent as base64."""
    choices: tuple[tuple[str, str], ...] = ()
    """What can be chosen, and how it is told."""
    chosen: str = ""
    """The one of them that holds now."""


@dataclass(frozen=True, slots=True)
class Action:
    """A button: a declared command of a stage, with what it takes."""

    stage: str
    command: str
    label: str
    arguments: dict[str, str]
    ask: Ask | None = None
    kind: Literal["first", "plain", "stop", "delete"] = "plain"
    """``first`` is what a person most likely wants next, ``stop`` is always in sight, ``delete`` ends what a card
    shows."""
    now: bool = True
    """Whether it can be done now."""
    confirm: str = ""
    """A question to be answered with yes before; none by default."""


@dataclass(frozen=True, slots=True)
class Line:
    """One thing that a card says, with what can be done about it."""

    key: str
    """The same whatever the text says, and another one for every line of a card."""
    text: str
    actions: tuple[Action, ...]


@dataclass(frozen=True, slots=True)
class Card:
    """Something that is kept, with what can be done with it."""

    key: str
    title: str
    text: str
    photo: Photo | None
    actions: tuple[Action, ...]
    more: tuple[Action, ...] = ()
    """What is done less often."""
    lines: tuple[Line, ...] = ()
    """What it holds, one by one."""
    lines_title: str = ""
    file: File | None = None


@dataclass(frozen=True, slots=True)
class Place:
    """Something on a map."""

    name: str
    label: str
    points: tuple[tuple[float, float], ...]
    """Its edge, x and y in metres."""
    x: float
    """Where it is said to be, metres."""
    y: float
    movable: bool = False


@dataclass(frozen=True, slots=True)
class Map:
    """Things seen from above, x upwards and y to the left; moving one calls a command that takes name, x and y."""

    title: str
    hint: str
    ground: tuple[tuple[float, float], ...]
    """The edge of what they stand on, metres."""
    places: tuple[Place, ...]
    """What lies lower first."""
    stage: str
    command: str


@dataclass(frozen=True, slots=True)
class Doing:
    """What goes on now."""

    text: str
    busy: bool = False
    steps: tuple[str, ...] = ()
    """What is planned in all, with what is done of it."""
    step: int = 0
    """The one of them that is at work or comes next, from 1; 0 where there are none."""
    since_ns: int = 0
    """When it began, nanoseconds since the epoch."""
    expected_s: float = 0.0
    """How long it will probably take from then on, seconds; 0 where nobody knows."""


@dataclass(frozen=True, slots=True)
class Question:
    """What the person is asked: nothing goes on until one of the answers is given."""

    text: str
    answers: tuple[Action, ...]
    about: str = ""
    """Names an outline, or is empty."""


@dataclass(frozen=True, slots=True)
class Notice:
    """How the last thing ended."""

    good: bool
    text: str
    help: tuple[str, ...] = ()
    """What is wrong, and what the person can do about it."""
    message: str = ""
    """Id of the message that said so."""
    tried: tuple[str, ...] = ()
    """What was tried in vain, under a title that comes first."""


@dataclass(frozen=True, slots=True)
class Told:
    """All that there is to say now."""

    doing: Doing
    question: Question | None = None
    notice: Notice | None = None
    view: View | None = None
    statements: tuple[Statement, ...] = ()
    actions: tuple[Action, ...] = ()
    map: Map | None = None
    cards_title: str = ""
    cards_hint: str = ""
    """Shown where there are no cards."""
    cards: tuple[Card, ...] = ()
    cards_actions: tuple[Action, ...] = ()
    """What can be done to have one more."""

    @property
    def photos(self) -> list[Photo]:
        """All pictures that are told of."""
        found = [card.photo for card in self.cards] + [self.view.photo if self.view else None]
        return [photo for photo in found if photo is not None]

    @property
    def files(self) -> list[File]:
        """All files that are told of."""
        return [card.file for card in self.cards if card.file is not None]


@dataclass(frozen=True, slots=True)
class Heard:
    """A message as it was recorded."""

    message: Message
    id: str
    causes: tuple[str, ...]
    """Ids of what the step that emitted it had consumed."""
    time_ns: int
    """When it was recorded, nanoseconds since the epoch."""


class Story(Protocol):
    """Follows the messages of a run and says what there is to see, to know and to do."""

    hears: tuple[type[Message], ...]
    """The messages that it follows; the others are not read."""

    def __init__(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        """``configs`` holds every stage's settings by stage name, as the graph runs with them."""
        ...

    def hear(self, heard: Heard) -> None:
        """Takes a message, in recorded order."""
        ...

    def recall(self) -> None:
        """Takes what is kept beyond runs, where there is no run to hear it from."""
        ...

    def tell(self, language: Language) -> Told:
        """What there is to say, in a language."""
        ...

    def say(self, refusal: str, language: Language) -> str:
        """Why a stage refused a call, in the words of people; what is not known stays as it was said."""
        ...


def load_story(graph: Graph) -> Story | None:
    """The story a graph names; None where it names none. Raises Refused where it cannot be loaded."""
    if graph.story is None:
        return None
    return graph.load("story", graph.story, Story)
