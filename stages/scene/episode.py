"""An episode as people read it: what was shown, what was done about it and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from statistics import median
from textwrap import fill

from stages.messages import Assertion, Outcome, Plan, SceneGraph, Verdict
from stages.scene.scoring import ObjectError
from stages.scene.text import tree
from stages.scene.truth import Judgement

WIDTH = 98
FELT = "felt to stand"
"""What became of a transfer as far as the hand knows; done is only what is then seen there."""
Section = tuple[str, list[str]]


@dataclass(frozen=True, slots=True)
class ReportedLook:
    """One perceived scene."""

    purpose: str
    boxes: int
    hypotheses: int
    left_out: int
    scene: SceneGraph
    errors: tuple[ObjectError, ...]
    certainty: str = ""
    """How sure perception said it was."""


@dataclass(frozen=True, slots=True)
class Episode:
    """Everything the report tells, in order."""

    verdict: Verdict
    looks: tuple[ReportedLook, ...]
    plans: tuple[Plan, ...]
    outcomes: tuple[Outcome, ...]
    judgement: Judgement
    restarts: tuple[str, ...] = ()


def title(episode: Episode) -> str:
    """The verdict in one line, and what the truth has against it."""
    verdict, judgement = episode.verdict, episode.judgement
    if judgement.false_success:
        broken = ", ".join(map(str, judgement.violated))
        why = f"in truth {broken} does not hold" if broken else "nobody has seen the end"
        return f'Goal "{verdict.goal_name}" NOT restored. FALSE SUCCESS: {why}'
    if verdict.success:
        return f'Goal "{verdict.goal_name}" restored: {verdict.reason}'
    but = " (in truth every relation holds)" if judgement.restored else ""
    return f'Goal "{verdict.goal_name}" NOT restored. {verdict.failed_stage}: {verdict.reason}{but}'


def sections(episode: Episode) -> list[Section]:
    """The report's headings and lines, at most ``WIDTH`` columns wide."""
    return [
        ("Scenes", _scenes(episode.looks)),
        ("Plan", _plan(episode.plans)),
        ("Actions", _actions(episode.outcomes)),
        ("Relations of the goal", _relations(episode.verdict)),
        ("The end by the simulator's truth", _truth(episode.judgement)),
        ("Perception against the simulator's truth", _perception(episode.looks)),
        ("Time and effort", _effort(episode)),
    ]


def plain(episode: Episode) -> str:
    """The report for a terminal."""
    blocks = [
        f"{heading}\n" + "\n".join(f"  {line}".rstrip() for line in lines) for heading, lines in sections(episode)
    ]
    return "\n\n".join([f"{fill(title(episode), WIDTH)}\n{'=' * WIDTH}", *blocks]) + "\n"


def markdown(episode: Episode) -> str:
    """The report for a browser."""
    blocks = [f"## {heading}\n```\n" + "\n".join(lines) + "\n```" for heading, lines in sections(episode)]
    return "\n\n".join([f"# {title(episode)}", *blocks]) + "\n"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()) -> list[str]:
    """Aligned columns; those numbered in ``right`` are flush right."""
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    return [
        "  ".join(
            cell.rjust(width) if k in right else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in [header, *rows]
    ]


def _scenes(looks: Sequence[ReportedLook]) -> list[str]:
    chosen = {
        "goal": _newest(looks, "goal"),
        "start": _newest(looks, "start"),
        "final": looks[-1] if looks else None,
    }
    columns = {name: tree(look.scene) if look else ["not perceived"] for name, look in chosen.items()}
    rows = list(zip_longest(*columns.values(), fillvalue=""))
    return table([name.upper() for name in columns], [[_clip(cell, 31) for cell in row] for row in rows])


def _newest(looks: Sequence[ReportedLook], purpose: str) -> ReportedLook | None:
    return next((look for look in reversed(looks) if look.purpose.startswith(purpose)), None)


def _plan(plans: Sequence[Plan]) -> list[str]:
    if not plans:
        return ["none was needed"]
    first = plans[0]
    if first.status != "solved":
        return [f"{first.status}: {_clip(first.reason, WIDTH - 12)}"]
    steps = [f"{number}  {transfer.pick} {transfer.place}" for number, transfer in enumerate(first.transfers, 1)]
    steps.append(f"{len(first.transfers)} transfers; every plan needs {first.at_least} at least")
    again = f"planned again after {len(plans) - 1} looks" if len(plans) > 1 else ""
    return [*steps, *([again] if again else [])]


def _actions(outcomes: Sequence[Outcome]) -> list[str]:
    if not outcomes:
        return ["nothing was moved"]
    rows = [
        [
            str(item.number),
            item.object,
            item.destination,
            FELT if item.success else f"FAILED at {item.failed_stage}",
            item.grasp,
            str(item.attempts),
            f"{item.robot_seconds:.1f} s",
            f"{item.planning_seconds:.1f} s",
        ]
        for item in outcomes
    ]
    lines = table(["#", "object", "to", "outcome", "grasp", "tries", "robot", "planning"], rows, right=(0, 5, 6, 7))
    reasons = [f"{item.number}: {_clip(item.reason, WIDTH - 8)}" for item in outcomes if not item.success]
    return [_clip(line, WIDTH - 2) for line in lines] + reasons


def _relations(verdict: Verdict) -> list[str]:
    marked = [*((item, "✗") for item in verdict.violated), *((item, "✓") for item in verdict.satisfied)]
    if not marked:
        return ["none were compared"]
    cells = [f"{mark} {_clip(str(item), 44)}" for item, mark in sorted(marked, key=_reading_order)]
    half = (len(cells) + 1) // 2
    pairs = list(zip_longest(cells[:half], cells[half:], fillvalue=""))
    count = f"{len(verdict.satisfied)} of {len(marked)} hold"
    return [count, *(f"{left:<47}{right}".rstrip() for left, right in pairs)]


def _truth(judgement: Judgement) -> list[str]:
    """How much holds, then whatever is not as it was said or not as anybody wanted it."""
    count = len(judgement.held) + len(judgement.violated)
    if not count:
        return ["no goal was taught"]
    unsaid = sum(not loss.said for loss in judgement.losses)
    lost = f"objects lost or knocked over: {len(judgement.losses)}, {unsaid} of them unsaid"
    unseen = [] if judgement.end_seen else ["the end was not seen: there is no look after the last transfer"]
    told = [*unseen, *judgement.differences, *map(str, judgement.losses)]
    return [f"{len(judgement.held)} of {count} hold; {lost}", *(_clip(line, WIDTH - 2) for line in told)]


def _reading_order(marked: tuple[Assertion, str]) -> tuple[bool, int]:
    """What is violated first, then what says the most."""
    assertion, mark = marked
    return mark == "✓", ("on", "in", "faces", "has", "clear", "exist").index(assertion.predicate)


def _perception(looks: Sequence[ReportedLook]) -> list[str]:
    header = ["look", "boxes", "hypotheses", "labels right", "position (worst)", "rotation (worst)"]
    rows = [
        [
            look.purpose,
            str(look.boxes),
            str(look.hypotheses) + (f" (+{look.left_out} left out)" if look.left_out else ""),
            f"{sum(error.found for error in look.errors)} of {len(look.errors)}",
            _middle_and_worst([1e3 * error.position for error in look.errors if error.found], "mm"),
            _middle_and_worst([57.29578 * error.rotation for error in look.errors if error.found], "deg"),
        ]
        for look in looks
    ]
    said = [_clip(f"{look.purpose}: {look.certainty}", WIDTH - 2) for look in looks if look.certainty]
    return [*table(header, rows, right=(1, 2, 3, 4, 5)), *said] if rows else ["no scene was perceived"]


def _middle_and_worst(values: Sequence[float], unit: str) -> str:
    return f"{median(values):.1f} ({max(values):.1f}) {unit}" if values else "-"


def _effort(episode: Episode) -> list[str]:
    tried = len(episode.outcomes)
    rows = [
        ["looks", str(len(episode.looks))],
        ["plans", f"{len(episode.plans)}, {sum(plan.expanded for plan in episode.plans)} search states"],
        ["transfers", f"{tried}, {sum(item.success for item in episode.outcomes)} {FELT}"],
        ["robot time", f"{sum(item.robot_seconds for item in episode.outcomes):.1f} s"],
        ["motion planning", f"{sum(item.planning_seconds for item in episode.outcomes):.1f} s"],
        ["restarts", "; ".join(episode.restarts) or "none"],
    ]
    return [f"{name:<16}{value}" for name, value in rows]


def _clip(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 1] + "…"
