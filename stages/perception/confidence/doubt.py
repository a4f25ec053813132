"""How sure an estimated scene is: probabilities of hypotheses and poses, spread, alternatives.

docs/perception/doubt.md explains it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages.digest import SceneEstimate
from stages.messages.scene import Alternative, ObjectPose, UnknownRegion
from stages.perception.confidence.calibration import Calibration, cost_of_an_object, hypothesis_probabilities
from stages.perception.confidence.comparison import Comparison, Model
from stages.perception.confidence.evidence import ORDINARY_NOISE, Evidence, Judged, Others, Rival
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.filter.proposals import Dof
from stages.perception.hypotheses.unexplained import UnexplainedRegion, is_contradicted, unknown_regions
from stages.perception.refinement.refinement import RefinedObject
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from stages.scene.catalogue import Catalogue

_PLANE = 0.02
"""Metres from the plane within which a reading that is no foreground is the plane's."""
_APART = 0.006, 0.015
"""Metres that two equal objects reach into each other where they are one that was found twice: nearer to each other
than half of their least dimension, and at any distance. Bowls that stand in each other do not."""
_OFF = 0.012
"""Metres along the ray, at one metre, beyond which a reading does not lie on a surface; grows with the square of depth
as the noise of triangulation does."""


@dataclass(frozen=True)
class PoseDoubt:
    """How sure the pose of one object is."""

    evidence: Evidence
    probability: float
    """That the pose is right within 2 cm and 15 degrees, modulo symmetries."""
    alternatives: Floats
    """A x 3 x 4 other poses, likeliest first."""
    shares: tuple[float, ...]
    """Probability of each of them."""
    contradicted: bool


@dataclass(frozen=True)
class SceneDoubt:
    """How sure a scene is."""

    probabilities: Floats
    """Of the hypotheses."""
    objects: tuple[PoseDoubt, ...]
    unknown: tuple[UnexplainedRegion, ...]


def judged(item: ObjectPose, refined: RefinedObject) -> Judged:
    """An object as the refiner leaves it, with the poses it compared by colour."""
    rivals = tuple(Rival(each.T_camera_object, each.nats) for each in refined.considered)
    return Judged(
        refined.label, refined.T_camera_object, item.confidence, rivals, item.box,
        sunk=refined.sunk, penetration=refined.penetration,
    )  # fmt: skip


def annotated(estimate: SceneEstimate, doubt: SceneDoubt) -> SceneEstimate:
    """The estimate with all that is known of how sure it is."""
    objects = tuple(map(_annotated, estimate.objects, doubt.objects))
    unknown = tuple(
        UnknownRegion(
            box=region.box, points=region.points, centre_table=region.centre_table, extent_table=region.extent_table
        )
        for region in doubt.unknown
    )
    return msgspec.structs.replace(estimate, objects=objects, probabilities=doubt.probabilities, unknown=unknown)


def _annotated(item: ObjectPose, found: PoseDoubt) -> ObjectPose:
    evidence = found.evidence
    return msgspec.structs.replace(
        item,
        probability=found.probability,
        spread_metres=evidence.spread_metres,
        spread_radians=evidence.spread_radians,
        alternatives=tuple(
            Alternative(T_camera_object=pose(T[:, :3], T[:, 3]), probability=share)
            for T, share in zip(found.alternatives, found.shares, strict=True)
        ),
        looked_through=evidence.looked_through,
        contradicted=found.contradicted,
    )


def noise_of(scene: ObservedScene) -> float:
    """Median distance of the plane's readings from it along their rays, metres: sensors differ by as much."""
    part = np.s_[::3, ::3]
    inverse, depth, factor = scene.plane_inverse[part], scene.depth[part], scene.factor[part]
    behind = factor * np.abs(1.0 / np.where(inverse > 0, inverse, 1.0) - depth)
    of_plane = behind[(inverse > 0) & (factor > 0) & ~scene.foreground[part] & (behind < _PLANE)]
    return max(5e-4, float(np.median(of_plane))) if len(of_plane) >= 200 else ORDINARY_NOISE


class Judge:
    """Judges scenes of one catalogue's objects."""

    def __init__(self, catalogue: Catalogue, *, dof: Dof, calibration: Calibration | None = None) -> None:
        self._catalogue = catalogue
        self._dof: Dof = dof
        self._calibration = calibration or Calibration.load()
        self._models: dict[str, Model] = {}

    def warm_up(self) -> None:
        """Lays out every object, so that the first image waits for nothing."""
        for label in self._catalogue.objects:
            self._model(label)

    def assess(self, scene: ObservedScene, objects: Sequence[Judged], log_weights: Floats, winner: int) -> SceneDoubt:
        """How sure the winning scene is; ``log_weights`` are those of all hypotheses of the image."""
        nat = self._calibration.hypothesis_scale * cost_of_an_object(scene, len(objects))
        probabilities = hypothesis_probabilities(log_weights, nat)
        layers = self.layers(scene, objects)
        found = self.evidence(scene, objects, layers, float(probabilities[winner]))
        doubts = tuple(_doubt(*each, self._calibration) for each in found)
        return SceneDoubt(probabilities, self._once(objects, doubts), unknown_regions(scene, layers))

    def evidence(
        self, scene: ObservedScene, objects: Sequence[Judged], layers: Sequence[Float32s], hypothesis: float
    ) -> list[tuple[Evidence, Others]]:
        """What the image says of each object's pose; ``hypothesis`` is the probability of the scene's."""
        noise, lonely = noise_of(scene), _unexplained(scene, layers)
        found: list[tuple[Evidence, Others]] = []
        for i, item in enumerate(objects):
            others = np.maximum.reduce([scene.plane_inverse, *layers[:i], *layers[i + 1 :]])
            T = np.array(item.T_camera_object[:3], float)
            look = Comparison(scene, self._model(item.label), T, layers[i], others)
            evidence, rest = look.evidence(item, self._calibration, hypothesis)
            found.append((replace(evidence, noise=noise, unexplained=_share(lonely, scene, item.box)), rest))
        return found

    def layers(self, scene: ObservedScene, objects: Sequence[Judged]) -> list[Float32s]:
        """The inverse depth of each object alone, H x W."""
        return [inverse_depth(self._model(o.label).shape.soup, o.T_camera_object, scene.view) for o in objects]

    def _once(self, objects: Sequence[Judged], doubts: Sequence[PoseDoubt]) -> tuple[PoseDoubt, ...]:
        """Of two equal objects that are each other's deepest neighbour and one and the same, the one that shows less
        cannot be there."""

        def doubled(i: int) -> bool:
            return any(
                doubts[k].evidence.shown > doubts[i].evidence.shown and self._same(objects[i], other)
                for k, other in enumerate(objects)
            )

        return tuple(replace(doubt, contradicted=doubt.contradicted or doubled(i)) for i, doubt in enumerate(doubts))

    def _same(self, one: Judged, other: Judged) -> bool:
        if one.label != other.label or one.penetration != other.penetration:
            return False
        distance = np.linalg.norm(one.T_camera_object[:3, 3] - other.T_camera_object[:3, 3])
        near = distance < 0.5 * self._catalogue[one.label].dimensions.min()
        return one.penetration > (_APART[0] if near else _APART[1])

    def _model(self, label: str) -> Model:
        if label not in self._models:
            self._models[label] = Model(self._catalogue[label], self._dof)
        return self._models[label]


def _doubt(evidence: Evidence, others: Others, constants: Calibration) -> PoseDoubt:
    """Alternatives keep their odds against the estimate, but share no more than what it leaves to 1."""
    probability = constants.probability(evidence.features())
    shares = probability * others.weights
    shares *= min(1.0, (1.0 - probability) / max(float(shares.sum()), 1e-9))
    contradicted = is_contradicted(evidence.looked_through)
    return PoseDoubt(evidence, probability, others.poses, tuple(shares.tolist()), contradicted)


def _unexplained(scene: ObservedScene, layers: Sequence[Float32s]) -> NDArray[np.bool_]:
    """Foreground readings that lie on no object, H x W; at silhouettes they may be of either side and count too."""
    nearest = np.maximum.reduce([scene.plane_inverse, *layers])
    gap = np.abs(1.0 / np.where(nearest > 0, nearest, np.inf) - scene.depth)
    return scene.foreground & (gap > _OFF * np.maximum(scene.depth, 1.0) ** 2)


def _share(mask: NDArray[np.bool_], scene: ObservedScene, box: Floats | None) -> float:
    """Share of the foreground in a box that is in the mask; 0 where there is no box."""
    if box is None:
        return 0.0
    x0, y0, x1, y1 = np.clip(np.round(box), 0, np.tile(mask.shape[::-1], 2)).astype(int).tolist()
    return float(mask[y0:y1, x0:x1].sum() / max(1, scene.foreground[y0:y1, x0:x1].sum()))
