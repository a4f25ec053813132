"""What may hide an object that is not seen, and where it hides nothing: looking behind and under things."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.planning.places.placements import Scene
from stages.planning.places.sight import hidden_share
from stages.planning.symbolic.problem import TABLE
from stages.scene.stance import Stances, Standing

_GRID = 0.03
"""Metres between the places at which an object is imagined."""
_HIDDEN = 0.5
"""Share of an imagined object's points that must be hidden for it not to be seen; where 62 % of a can's were, less than
a quarter of its pixels showed."""
_BEHIND = (0.0, 0.06, 0.12, 0.18)
"""Metres behind the place of what is moved that are to be seen afterwards."""


def hiders(missing: Sequence[Stances], scene: Scene, movable: Collection[str]) -> list[str]:
    """What may hide any of the ``missing`` objects, what hides most places first.

    What hangs in the air stands on something unseen, and comes first. Of a stack the top is moved first.
    """
    scores: dict[str, float] = {}
    imagined = list(_imagined(missing, scene))
    for name in scene.standing:
        share = np.inf if scene.hangs(name) else float(sum(_hides(name, place, scene) for place in imagined))
        top = _top(name, scene)
        if share > 0 and top in movable:
            scores[top] = max(share, scores.get(top, 0.0))
    return sorted(scores, key=lambda name: -scores[name])


def uncovers(item: Standing, place: Standing, eye: Floats) -> bool:
    """Whether an object hides nothing of where it stood, and of what is behind that, once it stands at ``place``."""
    away = item.outline.mean(0) - eye[:2]
    away /= np.linalg.norm(away)
    for distance in _BEHIND:
        T = item.T_table_stance.copy()
        T[:2, 3] += distance * away
        if hidden_share(replace(item, T_table_stance=T), [place], eye) > 0:
            return False
    return hidden_share(place, [item], eye) == 0


def _top(name: str, scene: Scene) -> str:
    """What stands highest on an object, itself where it carries nothing."""
    return next((_top(other, scene) for other, support in scene.supports.items() if support == name), name)


def _hides(name: str, imagined: Standing, scene: Scene) -> bool:
    assert scene.eye is not None
    hider = scene.standing[name]
    return imagined.separation(hider) > 0 and hidden_share(imagined, [hider], scene.eye) > _HIDDEN


def _imagined(missing: Sequence[Stances], scene: Scene) -> Iterator[Standing]:
    """The missing objects upright at every place of the table, as far as that was seen, and of the containers on it,
    where nothing stands."""
    if scene.eye is None or scene.surface is None:
        return
    supports = scene.supports.items()
    containers = [name for name, below in supports if below == TABLE and scene.standing[name].stance.cavity]
    standing_on = {
        support: [scene.standing[name] for name, below in supports if below == support]
        for support in (TABLE, *containers)
    }
    (x0, y0), (x1, y1) = scene.surface.min(0), scene.surface.max(0)
    for stances in missing:
        for x in np.arange(x0, x1, _GRID):
            for y in np.arange(y0, y1, _GRID):
                T = np.eye(4)
                T[:2, 3] = x, y
                item = Standing.at("", stances, T)
                for support, others in standing_on.items():
                    within = support == TABLE or regions.inside(item.bottom, scene.standing[support].floor)
                    if within and all(item.separation(other) > 0 for other in others):
                        yield scene.rested(item, support)
