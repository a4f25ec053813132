"""A recording told again from its beginning: what was to be seen and known at each moment."""

from __future__ import annotations

from pathlib import Path

import msgspec

from runner.page.story import Doing, Language, Notice, Photo, Question, Statement, Told, View
from runner.page.watch import Watch


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


def moments(recording: Path, language: Language) -> tuple[list[Moment], dict[str, Photo]]:
    """All moments of a recording as far as it is there, and the pictures they show by key.

    Raises :class:`runner.contract.Refused` where the graph's story cannot be loaded.
    """
    found, photos = list[Moment](), dict[str, Photo]()

    def note() -> None:
        heard, told = watch.newest, watch.tell(language)
        if heard is None or (found and _shown(found[-1]) == _shown(told)):
            return
        found.append(Moment((heard.time_ns - watch.began_ns) * 1e-9, heard.id, *_shown(told)))
        if told.view is not None:
            photos[told.view.photo.key] = told.view.photo

    watch = Watch(recording, note, lambda: True)
    watch.look(True)
    watch.read()
    return found, photos


def _shown(told: Told | Moment) -> tuple[Doing, Question | None, Notice | None, View | None, tuple[Statement, ...]]:
    return told.doing, told.question, told.notice, told.view, told.statements
