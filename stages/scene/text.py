"""Scene graphs as text that people read."""

from __future__ import annotations

from stages.messages import SceneEstimate, SceneGraph
from stages.scene.doubts import SURE
from stages.scene.relations import TABLE


def certainty(estimate: SceneEstimate) -> str:
    """How sure a scene is, in one line; empty where it was not judged, why where nothing was to be seen."""
    if estimate.unusable:
        return f"nothing is known: {estimate.unusable}"
    judged = sorted((item.probability, item.name) for item in estimate.objects if item.probability is not None)
    if estimate.probabilities is None:
        return ""
    parts = [f"sure of {sum(p >= SURE for p, _ in judged)} of {len(judged)} objects"]
    parts += [f"least sure: {name} {p:.2f}" for p, name in judged[:1]]
    contradicted = [item.name for item in estimate.objects if item.contradicted]
    parts += [f"contradicted: {', '.join(contradicted)}"] if contradicted else []
    parts += [f"unknown: {len(estimate.unknown)}"] if estimate.unknown else []
    return "; ".join(parts)


def support(scene: SceneGraph) -> dict[str, tuple[str, str]]:
    """What carries each object and how: name -> (supporter, ``on`` or ``in``), in the scene's order."""
    names = {item.name for item in scene.objects}
    found = {
        child: (supporter, item.predicate)
        for item in scene.assertions
        if item.predicate in ("on", "in")
        for child, supporter in [item.arguments]
        if child in names and supporter in names | {TABLE}
    }
    return {item.name: found.get(item.name, (TABLE, "on")) for item in scene.objects}


def tree(scene: SceneGraph) -> list[str]:
    """The scene as an indented tree, one line per object, with what it stands beside."""
    return [TABLE, *_branches(TABLE, support(scene), _neighbours(scene), indent="")]


def _neighbours(scene: SceneGraph) -> dict[str, str]:
    beside: dict[str, list[str]] = {}
    for virtual in scene.virtual_objects:
        beside.setdefault(virtual.child, []).append(virtual.parent)
    return {child: f" beside {', '.join(parents)}" for child, parents in beside.items()}


def _branches(root: str, carried: dict[str, tuple[str, str]], beside: dict[str, str], indent: str) -> list[str]:
    children = [name for name, (supporter, _) in carried.items() if supporter == root]
    lines: list[str] = []
    for child in children:
        last = child == children[-1]
        how = "" if root == TABLE else f"{carried[child][1]} "
        lines.append(f"{indent}{'└─' if last else '├─'} {how}{child}{beside.get(child, '')}")
        lines += _branches(child, carried, beside, indent + ("   " if last else "│  "))
    return lines
