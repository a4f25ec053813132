"""Objects that a scene itself suggests though no candidate shows them: what nothing explains, and what must carry what
hangs in the air."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.masks import Mask, box_of
from stages.geometry.poses import inverse, rotate
from stages.messages.digest import Candidate, Offer
from stages.messages.scene import ObjectPose
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.hypotheses.unexplained import UnexplainedRegion, unexplained, unknown_regions
from stages.perception.rendering.rasteriser import Float32s
from stages.scene import relations
from stages.scene.catalogue import Catalogue
from stages.scene.stance import Stances, Standing

_SHARE = 0.5
"""Of what it claims that an object must explain for which no detector speaks."""
_LEEWAY = 0.02
"""Metres by which what is seen of an object may be longer than the object."""
_HEIGHT = 0.01
"""Metres by which the height of what carries an object may differ from the gap below it."""
_AROUND = 0.05
"""Metres beside the bottom of an object in which what carries it may show."""
_LEAST = 12
"""Readings that must show of it: fewer tell nothing about where it is."""


class Suggestions:
    """Offers for one catalogue's objects."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._stances = {label: Stances(item) for label, item in catalogue.objects.items()}

    def of(self, scene: ObservedScene, objects: Sequence[ObjectPose], layers: Sequence[Float32s]) -> tuple[Offer, ...]:
        """What may be looked for in a scene of these ``objects``; ``layers`` are their inverse depths, H x W each.

        What carries something that hangs comes first.
        """
        return (*self._carriers(scene, objects, layers), *self._unknown(scene, layers))

    def carries(self, scene: ObservedScene, objects: Sequence[ObjectPose], k: int) -> bool:
        """Whether anything would hang in the air without the object with index ``k``."""
        rest = [*objects[:k], *objects[k + 1 :]]
        return len(self._gaps(self._standing(scene, rest))) > len(self._gaps(self._standing(scene, objects)))

    def collides(self, scene: ObservedScene, objects: Sequence[ObjectPose], k: int) -> bool:
        """Whether the object with index ``k`` is farther inside another one than a pose may be off."""
        standing, tolerances = self._standing(scene, objects), relations.Tolerances()
        own = standing.pop(objects[k].name)
        depths = (relations.penetration(own, other, tolerances) for other in standing.values())
        return any(depth > tolerances.contact for depth in depths)

    def _unknown(self, scene: ObservedScene, layers: Sequence[Float32s]) -> Iterator[Offer]:
        """Every object that is large enough in every region that no object explains, at first those as high as it.

        Of what another object stands on, or in front of, two ends may show: the two regions that are nearest to each
        other come first, as one.
        """
        regions = unknown_regions(scene, layers)
        together = sorted((one.joined(other) for one, other in combinations(regions, 2)), key=lambda each: each.size)
        for region in (*together[:1], *regions):
            fitting = [label for label in self._catalogue.objects if self._may_show(label, region)]
            top = float(region.centre_table[2] + region.extent_table[2] / 2)
            fitting.sort(key=lambda label: min(abs(height - top) for height in self._heights(label)))
            yield from _offers(fitting, region.box)

    def _may_show(self, label: str, region: UnexplainedRegion) -> bool:
        return bool(region.size < np.linalg.norm(self._catalogue[label].dimensions) + _LEEWAY)

    def _heights(self, label: str) -> list[float]:
        """How high an object is in each way that it rests, metres."""
        stances = self._stances[label]
        return [stances.of(R)[0].height for R in self._catalogue[label].resting]

    def _carriers(
        self, scene: ObservedScene, objects: Sequence[ObjectPose], layers: Sequence[Float32s]
    ) -> Iterator[Offer]:
        """Objects as high as the gap below each one that hangs, where something shows there that nothing explains."""
        standing = self._standing(scene, objects)
        for name, gap in self._gaps(standing).items():
            below = _below(scene, standing[name], gap) & unexplained(scene, layers, edge=0)
            if below.sum() >= _LEAST:
                labels = self._catalogue.objects
                fitting = [one for one in labels if any(abs(z - gap) < _HEIGHT for z in self._heights(one))]
                yield from _offers(fitting, box_of(below))

    def _standing(self, scene: ObservedScene, objects: Sequence[ObjectPose]) -> dict[str, Standing]:
        T_table_camera = inverse(scene.T_camera_table)
        poses = ((item.name, item.label, T_table_camera @ item.T_camera_object) for item in objects)
        return {name: Standing.at(name, self._stances[label], T) for name, label, T in poses}

    def _gaps(self, standing: Mapping[str, Standing]) -> dict[str, float]:
        """What hangs in the air, and how far above what is below it, metres."""
        everything, tolerances = list(standing.values()), relations.Tolerances()
        carried = relations.assertions(relations.supports(everything, tolerances))
        return relations.gaps(everything, carried, tolerances)


def _below(scene: ObservedScene, item: Standing, gap: float) -> Mask:
    """Readings in the gap below an object and a little beside it, H x W."""
    points = scene.view.rays() * scene.depth[..., None] - scene.T_camera_table[:3, 3]
    points = rotate(scene.T_camera_table[:3, :3].T, points)
    z = points[..., 2]
    found = (scene.depth > 0) & (z > item.z_bottom - gap) & (z < item.z_bottom)
    found[found] = regions.depth(item.outline, points[found][:, :2]) > -_AROUND
    return found


def _offers(labels: Sequence[str], box: Floats) -> Iterator[Offer]:
    """One region by each label that it may have, all of them equally likely."""
    for label in labels:
        candidate = Candidate(box=box, label=label, confidence=1.0 / len(labels))
        yield Offer(candidate=candidate, share=_SHARE, instead=True)
