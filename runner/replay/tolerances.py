"""Says whether this machine computes as the recording's did, and where it does not, how far fields may be off."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from runner.contract import Tolerance, Tolerances
from runner.inspect.compare import Difference
from runner.recording import provenance
from runner.recording.recording import Recording


def compare_origin(recording: Recording) -> tuple[bool, list[str]]:
    """Whether floats must come out equal to the last bit, and what has changed since the recording, as lines."""
    changes = provenance.changes
    packages, here, names = provenance.package_versions(), provenance.machine(), provenance.numerical(recording.graph)
    then = recording.aspect("packages", dict[str, str]())
    # An aspect that an older runner did not record cannot be said to have changed.
    before = {**here, **recording.aspect("machine", dict[str, str]())}
    same = provenance.fingerprint(before, then, names) == provenance.fingerprint(here, packages, names)
    lines: list[str] = []
    if not same:
        aspects = (aspect for aspect in before if aspect != "system")
        computing = "; ".join((*changes(then, packages, names), *changes(before, here, aspects)))
        lines.append(f"FINGERPRINT DIFFERS: {computing}: tolerances apply where a graph has them")
    others = (name for name in then if name not in names)
    source = {"source": provenance.revision(recording.graph) or "unknown", "runner": provenance.runner_version()}
    was = {
        "source": recording.run.get("revision") or "unknown",
        "runner": recording.run.get("runner", source["runner"]),
    }
    if other := [*changes(then, packages, others), *changes(was, source, source)]:
        lines.append(f"changed since the recording: {'; '.join(other)}")
    return same, lines


def outside(differences: Iterable[Difference], tolerances: Tolerances) -> Iterator[Difference]:
    """The differences that no tolerance allows."""
    return (found for found in differences if not _allowed(found, tolerances.get(found.owner)))


def _allowed(difference: Difference, tolerance: Tolerance | None) -> bool:
    if tolerance is None:
        return False
    near = difference.largest is not None and difference.largest <= tolerance.absolute
    return near or math.isinf(tolerance.absolute) or difference.share <= tolerance.share
