"""A lamp with a page: every kind of thing that a page can tell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np

from runner.contract import Command, Context, Message, Refused, Stage
from runner.page import story as s


class Blinked(Message, frozen=True, kw_only=True):
    times: int


class Switch(Command, frozen=True, kw_only=True):
    """Switches the lamp."""

    on: bool = False
    colour: Literal["red", "blue"] = "red"
    note: str = ""


class Blink(Command, frozen=True, kw_only=True):
    """Blinks."""

    answers = (Blinked,)

    times: int
    """At most 9."""


class Off(Command, frozen=True, kw_only=True):
    """Ends it."""


class Carry(Command, frozen=True, kw_only=True):
    """Puts it elsewhere."""

    name: str
    x: float
    y: float


class Lamp(Stage):
    def on_switch(self, switch: Switch, ctx: Context) -> None:
        ctx.log(f"is {switch.colour if switch.on else 'dark'} {switch.note}".rstrip(), level="debug")

    def on_blink(self, blink: Blink) -> Blinked:
        if blink.times > 9:
            raise Refused(f"times={blink.times}: makes people dizzy; valid: 1 to 9")
        return Blinked(times=blink.times)

    def on_carry(self, carry: Carry, ctx: Context) -> None:
        ctx.log(f"{carry.name} carried to {carry.x:.2f} {carry.y:.2f}")

    def on_off(self, off: Off, ctx: Context) -> None:
        ctx.log("stopped")


class LampStory:
    hears: tuple[type[Message], ...] = (Blinked, Carry)

    def __init__(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        assert list(configs) == ["lamp"]
        self._blinked, self._place = 0, (0.5, 0.0)
        self._photo = s.Photo("lamp.picture-0", np.full((48, 64, 3), 90, np.uint8))

    def hear(self, heard: s.Heard) -> None:
        match heard.message:
            case Blinked(times=times):
                self._blinked += times
            case Carry(x=x, y=y):
                self._place = (x, y)
            case _:
                pass

    def recall(self) -> None:
        self._blinked = 100

    def say(self, refusal: str, language: s.Language) -> str:
        return refusal if language == "en" else refusal.replace("makes people dizzy", "macht schwindlig")

    def tell(self, language: s.Language) -> s.Told:
        text = {"en": "has blinked {} times", "de": "hat {}-mal geblinkt"}[language].format(self._blinked)
        x, y = self._place
        square = ((x - 0.1, y - 0.1), (x + 0.1, y - 0.1), (x + 0.1, y + 0.1), (x - 0.1, y + 0.1))
        ground = ((0.0, -0.5), (1.0, -0.5), (1.0, 0.5), (0.0, 0.5))
        places = (s.Place("table", "table", ground, 0.5, 0.0), s.Place("lamp", "lamp", square, x, y, movable=True))
        ask = s.Ask("times", "How often", "1 to 9", "[0-9]+")
        colour = s.Ask("note", "Colour", kind="choice", choices=(("blue", "light blue"), ("red", "red")), chosen="red")
        outlines = tuple(
            s.Outline(surety, f"{surety} lamp", surety, "how sure", ((x, 20), (x + 9, 20), (x + 9, 40), (x, 40)))
            for x, surety in zip((2, 18, 34, 50), get_args(s.Surety), strict=True)
        )
        return s.Told(
            s.Doing(text, self._blinked > 0, ("Switches on.", "Switches off."), 1, 1),
            s.Question("Is it bright?", (s.Action("lamp", "switch", "Very", {"note": "very bright"}),), "unsure"),
            s.Notice(self._blinked < 5, "the lamp is well", ("Let it cool.",), "lamp.blinked#0"),
            s.View(self._photo, "A lamp.", outlines, (s.Arrow("up", (10, 30), (50, 20)),)),
            tuple(s.Statement(f"There is a {one.label}.", one.name, one.surety, one.how_sure) for one in outlines),
            (
                s.Action("lamp", "blink", "Blink", {}, ask, "first"),
                s.Action("lamp", "off", "Stop", {}, kind="stop"),
            ),
            s.Map("Where the lamp is", "Drag it.", ground, places, "lamp", "carry"),
            "Lamps",
            "No lamps.",
            (
                s.Card(
                    *("a", "A lamp", "It blinks.", self._photo, (s.Action("lamp", "blink", "Dizzy", {"times": "10"}),)),
                    more=(s.Action("lamp", "switch", "Label", {}, s.Ask("note", "What to write on it")),),
                    lines=(
                        s.Line("shade", "It has a shade.", (s.Action("lamp", "switch", "Take off", {"note": "bare"}),)),
                        s.Line("colour", "It is red.", (s.Action("lamp", "switch", "Paint", {}, colour),)),
                    ),
                    lines_title="Its parts",
                    file=s.File("f", "lamp.txt", "Export", np.frombuffer(b"a lamp", np.uint8)),
                ),
            ),
            (s.Action("lamp", "switch", "Import", {}, s.Ask("note", "A file", kind="file")),),
        )
