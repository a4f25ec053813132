"""Follows a run while somebody looks at the page, and keeps what there is to tell.

Like `runner view` it reads what is on the disk: however slow a page is, the graph never waits for it, and nothing is
sent once more. While nobody looks, nothing is read.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from mcap.records import Metadata

from runner.contract import Message
from runner.graph.graph import Graph
from runner.graph.reading import graph_from_json
from runner.message.codec import CodecError, Envelope, LogLine, open_envelope, unpack
from runner.page.story import Doing, Heard, Language, Story, Told, load_story
from runner.recording.container import POLL_SECONDS, Container, Entry, Growing, open_file
from runner.recording.recording import LOG, RUN

KEPT_LINES = 300
"""Log lines that a page shows."""
NOTHING = Told(Doing(""))
"""What is told of a graph that names nobody to tell its story."""


class Watch:
    """The story and the newest log lines of one run, as far as they have been read."""

    def __init__(self, recording: Path, changed: Callable[[], object], stopped: Callable[[], bool]) -> None:
        """``changed`` is called, on the thread that reads, after each record that changes something."""
        self.newest: Heard | None = None
        self.began_ns = 0
        """When the first record was made, nanoseconds since the epoch."""
        self.lines: deque[LogLine] = deque(maxlen=KEPT_LINES)
        self.caught_up = False
        """Whether all was read that there is: before, there is only the past to tell."""
        self.fault = ""
        """Why nothing is read any more though the run goes on."""
        self._recording = recording
        self._changed = changed
        self._stopped = stopped
        self._looked_at = threading.Event()
        self._telling = threading.Lock()
        self._story: Story | None = None
        self._told: dict[Language, Told] = {}
        """What was told last, by language."""
        self._prepared = False
        self._heard: dict[str, type[Message]] = {}
        """Types by topic."""

    def start(self) -> None:
        """Begins to read, on a thread of its own."""
        threading.Thread(target=self._follow, name="watch", daemon=True).start()

    def _follow(self) -> None:
        try:
            self.read()
        except Exception as error:
            self.fault = str(error) or type(error).__name__
        if self.fault and not self._stopped():
            print(f"nothing more can be told: {self.fault}", file=sys.stderr)
            self._changed()

    def look(self, somebody: bool) -> None:
        """Goes on where somebody looks, and rests where nobody does."""
        self._looked_at.set() if somebody else self._looked_at.clear()
        self.caught_up &= somebody

    def tell(self, language: Language) -> Told:
        """What there is to say now.

        Where the story fails, what was told last, in another language if need be: a page keeps its buttons.
        """
        with self._telling:
            try:
                self._told[language] = self._story.tell(language) if self._story else NOTHING
            except Exception as error:
                print(f"nothing new can be told: {type(error).__name__}: {error}", file=sys.stderr)
            return self._told.get(language) or next(reversed(self._told.values()), NOTHING)

    def say(self, refusal: str, language: Language) -> str:
        """Why a stage refused a call, in the words of a language where somebody tells the story and knows them."""
        try:
            return self._story.say(refusal, language) if self._story and refusal else refusal
        except Exception as error:
            print(f"{refusal!r} cannot be told: {type(error).__name__}: {error}", file=sys.stderr)
            return refusal

    def read(self) -> None:
        """Reads until the run ends, or as far as it is there once it is to stop."""
        while not self._recording.exists() and not self._stopped():
            time.sleep(POLL_SECONDS)
        with open_file(self._recording) as file:
            records = Container(Growing(file, self._at_end), str(self._recording))
            for record in records:
                self._take(record)
                self._rest()
        self.fault = records.damage[-1] if records.torn else ""

    def _rest(self) -> bool:
        """Waits while nobody looks; returns whether to stop. The graph itself is read at once: that takes a while."""
        while self._prepared and not self._looked_at.wait(1.0) and not self._stopped():
            pass
        return self._stopped()

    def _at_end(self) -> bool:
        if not self.caught_up and self._prepared and self._looked_at.is_set():
            self.caught_up = True
            self._changed()
        return self._rest()

    def _take(self, record: Entry | Metadata) -> None:
        if not isinstance(record, Metadata):
            self.began_ns = self.began_ns or record.message.log_time
        if isinstance(record, Metadata):
            if record.name == RUN:
                self._prepare(graph_from_json(record.metadata["graph"], str(self._recording)))
                self._changed()
        elif record.topic.startswith(LOG):
            with contextlib.suppress(CodecError):
                self.lines.append(unpack(LogLine, record.message.data))
                self._changed()
        elif (kind := self._heard.get(record.topic)) is not None:
            self._hear(kind, record.message.data, record.message.log_time)

    def _prepare(self, graph: Graph) -> None:
        story = load_story(graph)
        if story is not None:
            self._heard = {topic: kind for topic, kind in graph.topics().items() if issubclass(kind, story.hears)}
        self._story, self._prepared = story, True

    def _hear(self, kind: type[Message], payload: bytes, time_ns: int) -> None:
        """What cannot be told is named on stderr and left out: the rest is still worth knowing."""
        assert self._story is not None
        try:
            sealed = unpack(Envelope, payload)
            heard = Heard(open_envelope(kind, sealed), sealed.id, sealed.causes, time_ns)
            with self._telling:
                self._story.hear(heard)
            self.newest = heard
            self._changed()
        except Exception as error:
            print(f"a {kind.__name__} cannot be told: {type(error).__name__}: {error}", file=sys.stderr)


def told_so_far(recording: Path, language: Language) -> Told:
    """What there is to say of a run now."""
    watch = Watch(recording, lambda: None, lambda: True)
    watch.look(True)
    watch.read()
    return watch.tell(language)


def told_without_a_run(graph: Graph, language: Language) -> Told:
    """What there is to say of what a graph keeps beyond its runs."""
    story = load_story(graph)
    if story is None:
        return NOTHING
    story.recall()
    return story.tell(language)
