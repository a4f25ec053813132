"""Frames out of a recording: what a camera saw once, for the perception stages of another graph."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from runner.contract import Refused
from runner.message.codec import open_envelope
from stages.messages import Frame


class RecordedFrames:
    """The frames of one recording, in the order in which they were recorded."""

    def __init__(self, path: Path) -> None:
        """Raises :class:`Refused` where the file is no recording or holds no frame."""
        # Only this camera needs the reader and the MCAP library behind it.
        from runner.recording.recording import Recording

        self._recording = Recording(path)
        ids = [id for id, message in self._recording.messages.items() if message.type == Frame.__name__]
        # What a corrector passed on is what was looked at; the camera's own frames are there as well.
        self._ids = [id for id in ids if id.startswith("corrector.")] or ids
        if not self._ids:
            types = sorted({message.type for message in self._recording.messages.values()})
            raise Refused(f"{path}: holds no message of type Frame; there are {', '.join(types) or 'none at all'}")

    def __len__(self) -> int:
        return len(self._ids)

    def __iter__(self) -> Iterator[Frame]:
        for id in self._ids:
            yield open_envelope(Frame, self._recording.envelope(id))
