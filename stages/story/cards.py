"""Goals as cards: with their picture, what they ask for and how to ask for less, and as a file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runner.page.story import Action, Ask, Card, File, Line, Photo
from stages.messages import Assertion, Goal
from stages.scene.facing import SIDES, is_told, sides
from stages.scene.goals import MAX_RADIUS, packed
from stages.story.words import Words

GOALS = "goals"
"""The stage that keeps goals, as our graphs call it."""
NAME = r"[\p{L}\p{N}_\-]+"
"""What the name of a goal may be."""
WIDER = 0.04
"""Metres by which a region grows when somebody loosens it."""


@dataclass(frozen=True, slots=True)
class Remembered:
    """A goal, the picture in which it was shown, and itself as a file."""

    goal: Goal
    photo: Photo | None
    file: NDArray[np.uint8] | None = None
    """None where goals are not kept."""

    @staticmethod
    def of(goal: Goal) -> Remembered:
        """One that is kept."""
        file = np.frombuffer(packed(goal), np.uint8)
        bgr = cv2.imdecode(np.frombuffer(goal.picture, np.uint8), cv2.IMREAD_COLOR) if goal.picture else None
        photo = (
            None
            if bgr is None
            else Photo(_key(goal.picture), np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8))
        )
        return Remembered(goal, photo, file)


def card(kept: Remembered, actions: tuple[Action, ...], words: Words) -> Card:
    """What there is to see of a goal, and beside ``actions`` what can be done with one that is on disk.

    Where that fails it is said: whatever a file holds, the other cards and buttons stay.
    """
    try:
        return _card(kept, actions, words)
    except Exception as error:
        name, more = kept.goal.name, () if kept.file is None else tuple(_more(kept.goal.name, words))
        return Card(name, name, words.say("no_card", reason=f"{type(error).__name__}: {error}"), None, (), more)


def _card(kept: Remembered, actions: tuple[Action, ...], words: Words) -> Card:
    goal, name = kept.goal, kept.goal.name
    names = [item.name for item in goal.scene.objects]
    text = words.say("goal" if len(names) > 1 else "goal_of_one", count=len(names), objects=words.nouns(names))
    if kept.file is None:
        return Card(name, name, text, kept.photo, actions)
    file = File(_key(kept.file.tobytes()), f"{name}.zip", words.say("do_export"), kept.file)
    lines = tuple(_lines(goal, words))
    more = tuple(_more(name, words))
    return Card(name, name, text, kept.photo, actions, more, lines, words.say("matters"), file)


def _more(name: str, words: Words) -> Iterator[Action]:
    """What can be done with a goal on disk."""
    ask = Ask("to", words.say("new_name"), words.say("name_hint"), NAME)
    yield Action(GOALS, "rename", words.say("do_rename"), {"name": name}, ask)
    sure = words.say("forget_sure", name=name)
    yield Action(GOALS, "forget", words.say("do_forget"), {"name": name}, kind="delete", confirm=sure)


def add(words: Words) -> Action:
    """Has a goal kept that was exported."""
    return Action(GOALS, "add", words.say("do_add"), {}, Ask("file", words.say("add_file"), kind="file"))


def _key(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _lines(goal: Goal, words: Words) -> Iterator[Line]:
    """What a goal asks for, and how to ask for less."""
    scene, carried = goal.scene, {item.arguments[0]: item for item in goal.scene.assertions if _carries(item)}

    def strike(what: str, label: str) -> Action:
        return Action(GOALS, "strike", label, {"name": goal.name, "what": what})

    chosen = sides(scene)
    for item in scene.objects:
        noun, found = words.noun(item.name), carried.get(item.name)
        text = words.say("anywhere", object=noun)
        if found is not None:
            text = words.say(f"is_{found.predicate}", child=noun, supporter=words.noun(found.arguments[1]))
        loose = () if found is None else (strike(str(found), words.say("do_strike")),)
        out = (strike(item.name, words.say("do_leave_out", object=noun)),) if len(scene.objects) > 1 else ()
        yield Line(item.name, f"{text}.", (*loose, *out))
        if is_told(item):
            side = chosen.get(item.name, "any")
            text = words.say(f"faces_{side}", object=noun)
            yield Line(f"{item.name} faces", f"{text}.", (_face(goal.name, item.name, side, words),))
    for region in scene.virtual_objects:
        parts = {"child": words.noun(region.child), "parent": words.noun(region.parent)}
        text = words.say("is_beside", **parts, off=round(100 * region.radius))
        radius = min(region.radius + WIDER, MAX_RADIUS)
        wider = {"name": goal.name, "region": region.name, "radius": f"{radius:.2f}"}
        loosen = Action(GOALS, "loosen", words.say("do_loosen", off=round(100 * radius)), wider)
        yield Line(
            region.name, f"{text}.", (loosen, strike(f"in({region.name}, {region.child})", words.say("do_strike")))
        )


def _face(name: str, item: str, side: str, words: Words) -> Action:
    """Lets people choose which side an object shows."""
    choices = tuple((one, words.part(f"side_{one}")) for one in ("any", *SIDES))
    ask = Ask("side", words.say("which_side"), kind="choice", choices=choices, chosen=side)
    return Action(GOALS, "face", words.say("do_face"), {"name": name, "object": item}, ask)


def _carries(item: Assertion) -> bool:
    return item.predicate in ("on", "in")
