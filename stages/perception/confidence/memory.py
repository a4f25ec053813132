"""What is remembered of a scene: what is not seen, or hardly, stays where it was last seen or placed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import msgspec
import numpy as np

from stages.geometry import regions
from stages.geometry.poses import inverse
from stages.messages import Observation, SceneGraph
from stages.messages.scene import SceneObject
from stages.perception.filter.likelihood import ObservedScene, Shape
from stages.perception.hypotheses.unexplained import is_seen_empty
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from stages.scene import relations, virtual
from stages.scene.catalogue import Catalogue
from stages.scene.doubts import SURE, UNSURE, is_below
from stages.scene.naming import Named, names_kept, unique_names
from stages.scene.stance import TIPPED, Stances, standing_of, turned

_TRIANGLES = 500
_CLEARER = 2.0
"""How many times as much must show of what is seen now, but not surely, as showed of what was seen before in its
place; of what is surely seen it is enough that no less shows, or that what was seen before was in doubt."""
_SAME = 0.02
"""Metres within which a doubtful pose and a sure one from before may be one: as far off as a pose is that counts as
right."""
_THROUGH = 0.01
"""Metres by which an object that is remembered must reach into a surer one that is seen to be no more there, and by
which the heights of two overlap that do not stand on each other."""
_CONTENT = 0.5
"""Share of a container's footprint up to which something may stand in it wherever its floor is."""
_BESIDE = 0.005
"""Metres that something may be estimated beside the floor on which it stands."""
_WALL = 0.003
"""Metres of a container's wall that stands around what is in it."""


class Memory:
    """Completes scenes with what was known before.

    A place counts as empty where the camera looks through what would stand there, other objects apart: the test by
    which an estimate is contradicted, or, of what is flat, through nearly all that stands out of what is behind it.
    That holds in all of the image, also where no objects were looked for. What is hidden, or shows without being
    recognised, stays.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._stances = {label: Stances(item) for label, item in catalogue.objects.items()}

    def complete(
        self,
        scene: SceneGraph,
        known: Mapping[str, SceneObject],
        observation: Observation,
        wanted: Collection[str] = (),
    ) -> SceneGraph:
        """The scene, :meth:`named`, with those ``known`` objects that it lacks, or doubts, and that may still be where
        they were.

        A stranger at such an object's place is the object, taken for something else because little of it shows; but
        where more shows of the stranger, the object had been the mistake, as it had where a surer one that is seen
        reaches into it. Of two that are sure the one is believed that is ``wanted``, if the other one is not, or an
        equal of that is seen elsewhere.
        """
        if observation.T_base_camera is None:
            return scene
        seen = {item.name for item in scene.objects}
        missing = [item for name, item in known.items() if name not in seen]
        strangers = [item for item in scene.objects if item.name not in known]
        kept, taken = list[SceneObject](), set[str]()
        for item in missing:
            there = [stranger for stranger in strangers if self._overlap(item, stranger, scene)]
            false = {stranger.name for stranger in there}
            others = [other for other in scene.objects if other.name not in false]
            needed = item.name in wanted and not any(other.label == item.label for other in others)
            mistaken = any(_clearer(stranger, item, (stranger.name in wanted) - needed) for stranger in there)
            mistaken |= any(_surer(other, item) and self._overlap(item, other, scene, _THROUGH) for other in others)
            if not mistaken and not self._seen_empty(item, others, observation):
                kept.append(item)
                taken |= false
        best = {item.name: self._best(item, known.get(item.name), kept, scene, observation) for item in scene.objects}
        if not kept and all(best[item.name] is item for item in scene.objects):
            return scene
        return self.related(scene, (*(best[item.name] for item in scene.objects if item.name not in taken), *kept))

    def _best(
        self,
        item: SceneObject,
        before: SceneObject | None,
        kept: Sequence[SceneObject],
        scene: SceneGraph,
        observation: Observation,
    ) -> SceneObject:
        """Who surely saw something before knows better how it stands than a doubtful look at what little shows of it,
        as of a mug's handle: near where it was, or where it would reach into something else that is ``kept``. Nothing
        turns upside down where it stands, so one that seems to, and reaches into where it was, stands as it did."""
        if before is None or before.probability is None or item.probability is None:
            return item
        if not item.probability < SURE <= before.probability:
            return item
        apart = np.linalg.norm(item.T_base_object[:3, 3] - before.T_base_object[:3, 3])
        turn = turned(self._catalogue[item.label], item.T_base_object, before.T_base_object)
        stays = turn <= TIPPED and apart <= _SAME
        stays |= turn >= np.pi - TIPPED and self._overlap(item, before, scene, _THROUGH)
        if not stays and not any(self._overlap(item, other, scene, _THROUGH) for other in kept):
            return item
        others = [other for other in scene.objects if other.name != item.name]
        return item if self._seen_empty(before, others, observation) else before

    def named(
        self,
        scene: SceneGraph,
        known: Mapping[str, SceneObject],
        observation: Observation,
        still: Collection[str] = (),
    ) -> SceneGraph:
        """Equal objects with the names of those that are known where they stand: who moved one knows where it went.

        Where none is known to have stood, the only one of its kind keeps its name. But those that earlier views of the
        same scene have shown are ``still`` there unless the observation tells otherwise: their names are their own.
        """
        labels = [item.label for item in scene.objects]
        if not known or not labels:
            return scene
        before = {name: Named(item.label, item.T_base_object[:3, 3]) for name, item in known.items()}
        kept = names_kept(labels, np.stack([item.T_base_object[:3, 3] for item in scene.objects]), before)
        hidden = {
            name: item.label
            for name, item in known.items()
            if name in still and name not in kept and item.label in labels and self._may_stand(item, scene, observation)
        }
        kept = [
            item.name if name is None and labels.count(item.label) == 1 and item.name not in hidden else name
            for item, name in zip(scene.objects, kept, strict=True)
        ]
        return self.renamed(scene, unique_names([*labels, *hidden.values()], [*kept, *hidden])[: len(labels)])

    def _may_stand(self, item: SceneObject, scene: SceneGraph, observation: Observation) -> bool:
        """Whether what the scene lacks may be where it was: nothing else is seen there, nor that it is gone."""
        if observation.T_base_camera is None or any(self._overlap(item, other, scene) for other in scene.objects):
            return False
        return not self._seen_empty(item, scene.objects, observation)

    def renamed(self, scene: SceneGraph, names: Sequence[str]) -> SceneGraph:
        """The same scene, its objects with these names."""
        if all(item.name == name for item, name in zip(scene.objects, names, strict=True)):
            return scene
        now = {item.name: name for item, name in zip(scene.objects, names, strict=True)}
        objects = tuple(msgspec.structs.replace(item, name=now[item.name]) for item in scene.objects)
        beside = virtual.renamed(scene.virtual_objects, now)
        return self.related(msgspec.structs.replace(scene, objects=objects, virtual_objects=beside), objects)

    def _seen_empty(self, item: SceneObject, others: Sequence[SceneObject], observation: Observation) -> bool:
        view = _view(observation)
        layers = [self._layer(other, view, observation) for other in others]
        nearest = np.maximum.reduce([view.plane_inverse, *layers])
        return is_seen_empty(view, self._layer(item, view, observation), nearest)

    def _layer(self, item: SceneObject, view: ObservedScene, observation: Observation) -> Float32s:
        assert observation.T_base_camera is not None
        entry = self._catalogue[item.label]
        shape = entry.once("remembered", lambda: Shape.of(entry.simplified(_TRIANGLES)))
        return inverse_depth(shape.soup, inverse(observation.T_base_camera) @ item.T_base_object, view.view)

    def _overlap(self, item: SceneObject, stranger: SceneObject, scene: SceneGraph, depth: float = 0.0) -> bool:
        """Whether not both can stand there, by more than ``depth`` metres across; one may stand on the other, and what
        is small beside a container, or stands on its floor, may be in it."""
        a, b = standing_of((item, stranger), self._stances, scene.T_base_table)
        areas = [regions.area(one.outline) for one in (a, b)]
        outer, inner = (a, b) if areas[0] > areas[1] else (b, a)
        fits = regions.inside(inner.bottom, outer.floor, margin=-_BESIDE)
        fits &= regions.inside(inner.outline, outer.outline, margin=_WALL)
        if outer.stance.cavity and (fits or min(areas) < _CONTENT * max(areas)):
            return False
        upwards = min(a.z_top, b.z_top) - max(a.z_bottom, b.z_bottom)
        return upwards > _THROUGH and a.separation(b) < -depth

    def related(self, scene: SceneGraph, objects: Sequence[SceneObject]) -> SceneGraph:
        """The same scene with other objects: what carries what is found anew, regions stay among neighbours, each where
        these stand now."""
        standing = standing_of(objects, self._stances, scene.T_base_table)
        carried = relations.supports(standing, relations.Tolerances())
        poses = {item.name: item.T_base_object for item in objects}
        before = {item.name: item.T_base_object for item in scene.objects}
        moved = {name for name in before.keys() & poses.keys() if not np.array_equal(before[name], poses[name])}
        near = virtual.among_neighbours(scene.virtual_objects, carried, poses, moved)
        return msgspec.structs.replace(
            scene,
            objects=tuple(objects),
            virtual_objects=near,
            assertions=(*relations.assertions(carried), *virtual.assertions(near)),
        )


def _view(observation: Observation) -> ObservedScene:
    """All that the camera saw, also where it looked for no objects."""
    depth = observation.depth if observation.beyond is None else np.maximum(observation.depth, observation.beyond)
    return ObservedScene.of(depth, observation.foreground, observation.K, observation.T_camera_table)


def _surer(item: SceneObject, other: SceneObject) -> bool:
    """Whether an object is more likely right than another one."""
    return item.probability is not None and other.probability is not None and item.probability > other.probability


def _clearer(stranger: SceneObject, before: SceneObject, wanted: int) -> bool:
    """Whether what is seen now is believed rather than what was seen before in its place; of two doubtful guesses it is
    the likelier one, as at what shows a few pixels under a box. ``wanted`` is above 0 where only the stranger is, below
    where only the other one is."""
    if stranger.probability is not None and stranger.probability >= SURE and wanted >= 0:
        return wanted > 0 or is_below(before, SURE) or stranger.visible >= before.visible
    return stranger.visible > _CLEARER * before.visible or (is_below(before, UNSURE) and _surer(stranger, before))
