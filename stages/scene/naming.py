"""Names for the objects of a scene, where a label may occur more than once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence


def unique_names(labels: Sequence[str]) -> list[str]:
    """The label for the first of its kind, then ``label_2``, ``label_3``, ... in order."""
    seen: Counter[str] = Counter()
    names: list[str] = []
    for label in labels:
        seen[label] += 1
        names.append(label if seen[label] == 1 else f"{label}_{seen[label]}")
    return names
