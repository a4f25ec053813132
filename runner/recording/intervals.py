"""Sets of numbers that come mostly in order: kept as ranges, so that only their gaps take memory."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator


class Intervals:
    """A set of integers. Iterating gives its ranges in order, (first, one after the last); the length counts ranges."""

    def __init__(self, ranges: Iterable[tuple[int, int]] = ()) -> None:
        """The numbers of half-open ranges, which may come in any order and overlap."""
        self._starts: list[int] = []
        self._stops: list[int] = []
        for start, stop in sorted(ranges):
            if self._stops and start <= self._stops[-1]:
                self._stops[-1] = max(stop, self._stops[-1])
            elif start < stop:
                self._starts.append(start)
                self._stops.append(stop)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return zip(self._starts, self._stops, strict=True)

    def __len__(self) -> int:
        return len(self._starts)

    def __contains__(self, number: int) -> bool:
        at = bisect_right(self._starts, number) - 1
        return at >= 0 and number < self._stops[at]

    def __or__(self, other: Iterable[tuple[int, int]]) -> Intervals:
        """What is in either."""
        return Intervals([*self, *other])

    def __sub__(self, other: Intervals) -> Intervals:
        """What is in this one and not in the other."""
        return Intervals(gap for start, stop in self for gap in other.gaps(start, stop))

    @property
    def stop(self) -> int:
        """One more than the largest; 0 where there is none."""
        return self._stops[-1] if self._stops else 0

    def gaps(self, start: int, stop: int) -> Iterator[tuple[int, int]]:
        """The ranges between two numbers that are not in the set."""
        at = bisect_right(self._stops, start)
        while at < len(self._starts) and self._starts[at] < stop:
            if start < self._starts[at]:
                yield start, self._starts[at]
            start = self._stops[at]
            at += 1
        if start < stop:
            yield start, stop

    def add(self, number: int) -> None:
        """Puts a number in; at once where it is the next after the largest."""
        if self._stops and number == self._stops[-1]:
            self._stops[-1] += 1
            return
        touched = slice(bisect_left(self._stops, number), bisect_right(self._starts, number + 1))
        self._starts[touched] = [min([number, *self._starts[touched]])]
        self._stops[touched] = [max([number + 1, *self._stops[touched]])]

    def keep(self, most: int) -> None:
        """Lets go of the lowest ranges where there are twice as many as ``most``."""
        if len(self._starts) > 2 * most:
            del self._starts[:-most], self._stops[:-most]

    def discard(self, number: int) -> None:
        """Takes a number out where it is in."""
        at = bisect_right(self._starts, number) - 1
        if at >= 0 and number < self._stops[at]:
            rest = Intervals([(self._starts[at], number), (number + 1, self._stops[at])])
            self._starts[at : at + 1] = rest._starts
            self._stops[at : at + 1] = rest._stops
