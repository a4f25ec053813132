"""Which fields of which topics differ between messages that should be equal: how often, and by how much at most."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable

import msgspec

from runner.inspect.compare import Difference
from runner.inspect.info import Cells, table


class FieldChange(msgspec.Struct):
    """All differences of one field of one topic."""

    topic: str
    field: str
    """Without indices: ``objects[].T_camera_object[]``."""
    messages: int = 0
    """How many messages differ in it."""
    largest: float | None = None
    """Largest absolute difference; None where the values are no numbers."""
    first: str = ""
    """Id of the first message that differs in it."""

    def add(self, messages: int, largest: float | None, first: str) -> None:
        """Counts further messages."""
        self.first = self.first or first
        self.messages += messages
        self.largest = max((gap for gap in (self.largest, largest) if gap is not None), default=None)


class Summary:
    """Collects differences message by message; what several processes collected is merged."""

    def __init__(self, changes: Iterable[FieldChange] = ()) -> None:
        """``changes`` are what other summaries found."""
        self._compared = Counter[str]()
        self._fields: dict[tuple[str, str], FieldChange] = {}
        for change in changes:
            self._field(change.topic, change.field).add(change.messages, change.largest, change.first)

    def add(self, topic: str, id: str, differences: Iterable[Difference]) -> bool:
        """Enters one compared message; returns whether it differs."""
        found: dict[str, list[float | None]] = defaultdict(list)
        for difference in differences:
            found[difference.pattern].append(difference.largest)
        for field, gaps in found.items():
            largest = max((gap for gap in gaps if gap is not None), default=None)
            self._field(topic, field).add(1, largest, id)
        self._compared[topic] += 1
        return bool(found)

    @property
    def changes(self) -> list[FieldChange]:
        """One entry per field that differs, by topic, in the order in which they were found."""
        return sorted(self._fields.values(), key=lambda change: change.topic)

    def lines(self) -> list[str]:
        """A table of all fields that differ; nothing where none does."""
        rows: list[Cells] = []
        for change in self.changes:
            compared = self._compared[change.topic]
            messages = f"{change.messages} of {compared}" if compared else str(change.messages)
            largest = "-" if change.largest is None else f"{change.largest:.3g}"
            rows.append((change.topic, change.field, messages, largest, change.first))
        return table(("topic", "field", "messages", "largest", "first"), rows)

    def _field(self, topic: str, field: str) -> FieldChange:
        return self._fields.setdefault((topic, field), FieldChange(topic, field))
