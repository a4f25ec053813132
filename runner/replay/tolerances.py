"""Says whether this machine computes as the recording's did, and where it does not, how far fields may be off."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

from runner.contract import Tolerance, Tolerances
from runner.inspect.compare import Difference
from runner.recording.provenance import fingerprint, machine, numerical, package_versions, revision, runner_version
from runner.recording.recording import Recording

UNKNOWN = "absent"


class Origin:
    """What has changed between the recording and here."""

    def __init__(self, recording: Recording) -> None:
        packages, here, names = package_versions(), machine(), numerical(recording.graph)
        then = recording.aspect("packages", dict[str, str]())
        # An aspect that an older runner did not record cannot be said to have changed.
        before = {**here, **recording.aspect("machine", dict[str, str]())}
        self.same = fingerprint(before, then, names) == fingerprint(here, packages, names)
        """True where floats must come out equal to the last bit."""
        self.computing = list(_changes({name: then.get(name, UNKNOWN) for name in names}, packages))
        self.computing += [change for change in _changes(before, here) if not change.startswith("system ")]
        others = {name: version for name, version in then.items() if name not in names}
        source = {"source": recording.run.get("revision") or "unknown"}
        runner = {"runner": recording.run["runner"]} if "runner" in recording.run else {}
        now = {"source": revision(recording.graph) or "unknown", "runner": runner_version()}
        self.other = [*_changes(others, packages), *_changes({**source, **runner}, now)]

    def lines(self) -> Iterator[str]:
        """For people, what matters most first; nothing where nothing has changed."""
        if not self.same:
            yield f"FINGERPRINT DIFFERS: {'; '.join(self.computing)}: tolerances apply where a graph has them"
        if self.other:
            yield f"changed since the recording: {'; '.join(self.other)}"


def _changes(then: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    for name, value in then.items():
        if now.get(name, UNKNOWN) != value:
            yield f"{name} {value} -> {now.get(name, UNKNOWN)}"


def outside(differences: Iterable[Difference], tolerances: Tolerances) -> Iterator[Difference]:
    """The differences that no tolerance allows."""
    return (found for found in differences if not _allowed(found, tolerances.get(found.owner)))


def _allowed(difference: Difference, tolerance: Tolerance | None) -> bool:
    if tolerance is None:
        return False
    near = difference.largest is not None and difference.largest <= tolerance.absolute
    return near or math.isinf(tolerance.absolute) or difference.share <= tolerance.share
