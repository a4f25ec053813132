"""A recording told again from its beginning: what was to be seen and known at each moment."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path

import msgspec
from starlette.concurrency import run_in_threadpool

from runner.page.feed import shape
from runner.page.pictures import jpeg
from runner.page.story import Doing, Language, Notice, Question, Statement, Told, View
from runner.page.watch import Watch

KEPT = 4
"""Recordings told again that are kept, each in a language."""


class Moment(msgspec.Struct, frozen=True):
    """What there was to say from then on, until the next moment."""

    seconds: float
    """Since the recording began."""
    message: str
    """Id of the message that brought it about."""
    doing: Doing
    question: Question | None
    notice: Notice | None
    view: View | None
    statements: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class Past:
    """A recording told again, small enough to be kept."""

    moments: bytes
    """As JSON."""
    photos: dict[str, bytes]
    """JPEG of the pictures that moments show, by key."""
    size: int
    """Bytes that the recording had when it was read."""


def retold(recording: Path, language: Language) -> Past:
    """All moments of a recording as far as it is there.

    Raises :class:`runner.contract.Refused` where the graph's story cannot be loaded.
    """
    size, moments, photos = recording.stat().st_size, list[msgspec.Raw](), dict[str, bytes]()
    newest: _Shown | None = None

    def note() -> None:
        nonlocal newest
        heard, told = watch.newest, watch.tell(language)
        if heard is None or newest == (shown := _shown(told)):
            return
        newest = shown
        moment = Moment((heard.time_ns - watch.began_ns) * 1e-9, heard.id, *shown)
        moments.append(msgspec.Raw(msgspec.json.encode(moment, enc_hook=shape)))
        if told.view is not None and told.view.photo.key not in photos:
            photos[told.view.photo.key] = jpeg(told.view.photo)

    watch = Watch(recording, note, lambda: True)
    watch.look(True)
    watch.read()
    return Past(msgspec.json.encode(moments), photos, size)


class Pasts:
    """Recordings told again: each is read once for all who wait for it, and the newest are kept."""

    def __init__(self) -> None:
        self._readings: dict[tuple[Path, Language], asyncio.Task[Past]] = {}
        """What was wanted last comes last."""

    async def of(self, recording: Path, language: Language, *, grown: bool = False) -> Past:
        """A recording told again; where it may have ``grown`` since, what was read then is enough."""
        reading = self._readings.pop((recording, language), None)
        if reading is None or (reading.done() and _is_outdated(reading, 0 if grown else recording.stat().st_size)):
            reading = asyncio.create_task(run_in_threadpool(retold, recording, language))
        self._readings[recording, language] = reading
        self._readings = dict(list(self._readings.items())[-KEPT:])
        return await asyncio.shield(reading)


def _is_outdated(reading: asyncio.Task[Past], size: int) -> bool:
    """Whether it has failed, or was begun before the recording had ``size`` bytes."""
    return reading.exception() is not None or reading.result().size < size


_Shown = tuple[Doing, Question | None, Notice | None, View | None, tuple[Statement, ...]]


def _shown(told: Told) -> _Shown:
    return told.doing, told.question, told.notice, told.view, told.statements
