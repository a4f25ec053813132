"""What `benchmarks.page` shows and slows: a graph that computes all the time, and a story that has a picture."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import cv2
import numpy as np

from benchmarks.runner.recording_stages import Camera, Pace, Picture, Word
from runner.contract import Context, Message, Stage
from runner.page.story import Doing, Heard, Language, Outline, Photo, Told, View

SIZE = 160
"""Of the matrices that are multiplied: some milliseconds a time."""


class Photographer(Camera):
    """A camera whose pictures are as smooth as photographs: noise would be five times as large as a JPEG."""

    def __init__(self, config: Pace) -> None:
        super().__init__(config)
        rng = np.random.default_rng(0)
        shades = cv2.resize(rng.uniform(40, 215, (24, 32, 3)), (640, 480), interpolation=cv2.INTER_CUBIC)
        self._rgb = np.clip(shades + rng.normal(0, 4, shades.shape), 0, 255).astype(np.uint8)


class Grinder(Stage):
    """Says a word each time it has computed something."""

    device = True

    def source(self, ctx: Context) -> Iterator[Word]:
        """Never ends."""
        matrix = np.random.default_rng(0).normal(size=(SIZE, SIZE))
        number = 0
        while os.getppid() != 1:
            for _ in range(8):
                np.linalg.eigvalsh(matrix @ matrix.T)
            number += 1
            yield Word(number=number)


class PictureStory:
    """The newest picture with eight outlines; its key says when it was taken."""

    hears: tuple[type[Message], ...] = (Picture,)

    def __init__(self, configs: Mapping[str, Mapping[str, Any]], commands: Mapping[str, Collection[str]]) -> None:
        self._photo: Photo | None = None

    def hear(self, heard: Heard) -> None:
        """Takes a picture."""
        assert isinstance(heard.message, Picture)
        self._photo = Photo(str(heard.message.taken_ns), heard.message.rgb)

    def recall(self) -> None:
        """Nothing is kept."""

    def say(self, refusal: str, language: Language) -> str:
        """As it is."""
        return refusal

    def tell(self, language: Language) -> Told:
        """The picture."""
        turns = np.linspace(0, 2 * np.pi, 40)
        ring = np.column_stack([np.cos(turns), np.sin(turns)]) * 30
        outlines = tuple(
            Outline(
                f"thing {k}", f"thing {k}", "sure", "sure", tuple((int(70 * k + x + 40), int(y + 200)) for x, y in ring)
            )
            for k in range(8)
        )
        view = None if self._photo is None else View(self._photo, "noise", outlines)
        return Told(Doing("computes", busy=True, since_ns=1), view=view)
