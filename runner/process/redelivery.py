"""What the recorder has and consumers have not done with: sent again to who may have missed it.

A process that is killed takes with it the last messages that it has sent to some consumers, and not to others; one that
takes the place of another has heard nothing yet. The recorder judges both: what it has was sent, and what no step has
consumed is still to be done.
"""

from __future__ import annotations

import itertools
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import itemgetter
from typing import NamedTuple

from runner.graph.graph import Route
from runner.message.codec import Envelope, Step, answered
from runner.message.ids import Recent, number_on
from runner.message.packet import Process

LATEST_SECONDS = 0.5
"""After that the newest message of an edge of policy ``latest`` is offered again, then after twice the time, ..."""

Send = Callable[[str, bytes, bool], None]
"""Sends a payload under a key; the last argument says whether it may be dropped where nobody takes it."""


class _Message(NamedTuple):
    number: int
    """In the order in which all messages came."""
    id: str
    payload: bytes


class _Waiting:
    """What one consumer, all of its replicas or one of them, has not done with on one port."""

    def __init__(self, route: Route) -> None:
        self.route = route
        self.messages: OrderedDict[str, _Message] = OrderedDict()
        """By id."""
        self.kept: deque[_Message] = deque(maxlen=route.kept)
        """The newest of what has been used and may be used again."""
        self.offer_at = 0.0
        self.pause = LATEST_SECONDS

    def add(self, message: _Message) -> None:
        if self.route.policy == "latest":
            self.messages.clear()
            self.pause = LATEST_SECONDS
            self.offer_at = time.monotonic() + self.pause
        self.messages[message.id] = message

    def done(self, id: str) -> bool:
        message = self.messages.pop(id, None)
        if message is not None and self.route.kept:
            self.kept.append(message)
        return message is not None


class Redelivery:
    """All edges of a run. Not to be called from several threads at once."""

    def __init__(self, topics: Mapping[str, tuple[Route, ...]], send: Send) -> None:
        """``topics`` are the edges by the ``STAGE/PORT`` that they come from."""
        self._send = send
        self._edges = {topic: dict(_edges(routes)) for topic, routes in topics.items()}
        self._by_place = {place: waiting for edges in self._edges.values() for place, waiting in edges.items()}
        self._latest = [
            (taker, waiting) for (_, taker, _), waiting in self._by_place.items() if waiting.route.policy == "latest"
        ]
        self._open: dict[str, dict[str, tuple[str, ...]]] = {}
        """Causes of the messages, by stage and id, whose step has not come yet."""
        self._numbers = itertools.count()
        self._recent = Recent[str, None]()
        """Ids of messages that have come lately."""
        self._early = Recent[tuple[str, int, str, str], None]()
        """(stage, taker, port, id) done with before it came: its publisher's link is the slower one."""

    def note_message(self, topic: str, message: Envelope, payload: bytes) -> Iterator[tuple[str, int, str]]:
        """Takes a message that has come; yields (stage, taker, port) of consumers that had done with it already.

        Its publisher has died meanwhile and its successor, which has sent it once more, does not know that.
        """
        id = message.id
        arrived = _Message(next(self._numbers), id, payload)
        unfinished = self._open.setdefault(topic.partition("/")[0], {})
        known = id in self._recent or id in unfinished
        unfinished[id] = message.causes
        self._recent[id] = None
        for place, waiting in self._edges.get(topic, {}).items():
            early = (*place, id) in self._early
            self._early.pop((*place, id), None)
            if early or (known and id not in waiting.messages):
                yield place
            elif not known:
                waiting.add(arrived)

    def note_step(self, step: Step) -> None:
        """Takes a step; one that failed is taken again, and emits the same once more."""
        for id in step.emitted if step.outcome != "failed" else ():
            self._open.get(step.stage, {}).pop(id, None)
        for port, id in answered(step):
            for taker in (step.replica, -1):
                waiting = self._by_place.get((step.stage, taker, port))
                if waiting is not None and not waiting.done(id) and id not in self._recent:
                    self._early[step.stage, taker, port, id] = None

    def sources_of(self, consumer: str) -> set[str]:
        """The stages that a stage gets messages from."""
        topics = (topic for topic, edges in self._edges.items() if any(stage == consumer for stage, _, _ in edges))
        return {topic.partition("/")[0] for topic in topics}

    def catch_up(self, process: Process) -> None:
        """Sends a new process all that it has to do: first what its predecessor was in the midst of, then the oldest.

        A step that is taken again in the same order, whatever ports it takes from, emits the same ids.
        """
        begun = {id for causes in self._open.get(process.stage, {}).values() for id in causes}
        waits = [
            (message.id not in begun, message, waiting)
            for (stage, taker, _), waiting in self._by_place.items()
            if stage == process.stage and taker in (process.replica, -1)
            for message in (*waiting.kept, *waiting.messages.values())
        ]
        for _, message, waiting in sorted(waits, key=itemgetter(0, 1)):
            self._again(process.replica, waiting, [message])

    def undone(self, stage: str) -> Iterator[tuple[str, str, str]]:
        """(consumer, port, id) of the parts that a stage has sent and nobody has done with, the oldest first."""
        for topic, edges in self._edges.items():
            if topic.partition("/")[0] == stage:
                for (consumer, _, port), waiting in edges.items():
                    yield from ((consumer, port, id) for id in waiting.messages if waiting.route.shared)

    def numbers(self, stage: str) -> dict[str, int]:
        """Next sequence number, by output port, after what a stage has sent in steps that were never done."""
        numbers: dict[str, int] = {}
        number_on(numbers, self._open.get(stage, {}))
        return numbers

    def lost(self, process: Process, living: Iterable[Process]) -> None:
        """Sends what a dead process has published, and nobody has done with, to those who may not have got it."""
        replicas = list(living)
        for topic, edges in self._edges.items():
            if topic.partition("/")[0] == process.stage:
                for (stage, taker, _), waiting in edges.items():
                    for one in replicas:
                        if one.stage == stage and taker in (one.replica, -1):
                            self._again(one.replica, waiting, waiting.messages.values())

    def offer_latest(self) -> None:
        """Sends the newest of each edge of policy ``latest`` again that has not been used for a while."""
        now = time.monotonic()
        for taker, waiting in self._latest:
            if waiting.messages and now > waiting.offer_at:
                waiting.pause *= 2
                waiting.offer_at = now + waiting.pause
                self._again(taker, waiting, waiting.messages.values())

    def _again(self, replica: int, waiting: _Waiting, messages: Iterable[_Message]) -> None:
        route = waiting.route
        for message in messages:
            self._send(f"again/{route.consumer}/{replica}/{route.input}", message.payload, route.policy == "latest")


def _edges(routes: Iterable[Route]) -> Iterator[tuple[tuple[str, int, str], _Waiting]]:
    for route in routes:
        for taker in route.takers:
            yield (route.consumer, taker, route.input), _Waiting(route)
