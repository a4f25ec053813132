"""How sure an estimated scene is: probabilities of hypotheses and poses, spread, alternatives.

docs/perception/doubt.md explains it.

Raw weights exp(-lambda d) are far too sharp: neighbouring readings err together, and the sensor's and the model's
biases are in no likelihood. Costs become log-odds ("nats") through scales, and evidence becomes a probability through
a logistic model, that ``python -m benchmarks.calibration`` fits on rendered scenes of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.geometry.poses import compose, exp_so3, pose, rotate, symmetry_angle
from stages.messages.digest import SceneEstimate
from stages.messages.scene import Alternative, ObjectPose, UnknownRegion
from stages.perception.confidence.unexplained import Region, is_contradicted, looked_through, unknown_regions
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.filter.proposals import Dof, Proposals, distinct_best
from stages.perception.refinement.refinement import RefinedObject
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from stages.scene.catalogue import Catalogue, CatalogueObject

RIGHT_METRES = 0.02
RIGHT_RADIANS = np.deg2rad(15.0)
"""A pose within these of the truth, modulo the object's symmetries, is right."""
FEATURES = (
    "margin", "fit", "shown", "gain", "looked through", "spread", "hypothesis", "confidence", "unexplained", "sunk",
    "penetration",
)  # fmt: skip
"""What a probability is made of; :func:`Evidence.features`."""
ORDINARY_NOISE = 0.00125
"""Metres; where the plane shows too little to tell."""
CONSTANTS = Path(__file__).with_name("calibration.yaml")
_PLANE = 0.02
"""Metres from the plane within which a reading that is no foreground is the plane's."""
_DETAIL = 60.0
"""Apparent diameter at which poses are compared, pixels."""
_FORM = CostForm().truncated(0.015)
_PIXEL = 0.003
"""Metres by which a reading that speaks against a pose is off, for the unit of evidence."""
_TURNS = np.deg2rad(np.arange(10.0, 360.0, 10.0))
_SHIFTS = np.array([-0.05, -0.03, -0.015, 0.015, 0.03, 0.05])
_REFINED = 24
_SCALES = ((np.deg2rad(10.0), 0.010), (np.deg2rad(3.5), 0.0035), (np.deg2rad(1.2), 0.0012))
"""Radians and metres by which the nearest poses are spread: from what an image can leave open to what it resolves."""
_NEARBY = 96
"""Poses at each of these scales."""
_ABOUT = (np.deg2rad(60.0), 0.06)
"""Radians and metres within which a pose counts as the same one, spread out, rather than as another."""
_KEPT = 4
_LIKELY = 0.1
"""Alternatives kept at most, and the least weight that one has relative to the estimate."""
_OFF = 0.012
"""Metres along the ray, at one metre, beyond which a reading does not lie on a surface; grows with the square of depth
as the noise of triangulation does."""
_DEEPEST = 0.04
"""Metres in the plane or in another object from which on an object lies as wrong as can be."""
_FARTHEST = 3.0
_CAP = 12.0
"""Nats beyond which evidence is as good as any."""


@dataclass(frozen=True)
class Calibration:
    """Constants that turn costs and evidence into probabilities."""

    hypothesis_scale: float
    """Objects left unexplained by which scenes must differ for one nat."""
    pose_scale: float
    """Readings that count as one independent reading when poses of an object are compared."""
    spread_scale: float
    """Factor from the spread of the tempered likelihood to that of the errors."""
    bias: float
    weights: tuple[float, ...]
    """One per feature."""
    centres: tuple[float, ...]
    scales: tuple[float, ...]
    """Mean and deviation by which each feature is standardised."""

    @staticmethod
    @cache
    def load(path: Path = CONSTANTS) -> Calibration:
        """Reads the constants that the benchmark wrote.

        Raises:
            Refused: the file is not of that form; names file and key.
        """
        try:
            found = msgspec.convert(yaml.safe_load(path.read_text()), Calibration)
        except (OSError, yaml.YAMLError, msgspec.ValidationError) as error:
            raise Refused(f"{path}: {error}; `python -m benchmarks.calibration` writes this file") from None
        for key in ("weights", "centres", "scales"):
            if len(getattr(found, key)) != len(FEATURES):
                raise Refused(
                    f"{path}: {key} has {len(getattr(found, key))} numbers; there are {len(FEATURES)} features"
                )
        return found

    def probability(self, features: Floats) -> float:
        """That a pose with these features is right."""
        standard = standardised(features, np.array(self.centres), np.array(self.scales))
        return float(1.0 / (1.0 + np.exp(-(self.bias + (standard * np.array(self.weights)).sum()))))


def standardised(features: Floats, centres: Floats, scales: Floats) -> Floats:
    """Features in deviations from their mean; bounded, so that a model never reaches far beyond what it has seen.

    The margin, which comes first, has bounds of its own.
    """
    bounds = np.append(np.inf, np.full(len(FEATURES) - 1, _FARTHEST))
    return np.clip((features - centres) / scales, -bounds, bounds)


@dataclass(frozen=True)
class Rival:
    """A pose that depth found nearly equal to the estimate."""

    T_camera_object: Floats
    """3 x 4."""
    nats: float
    """Log-odds of the estimate against it."""


@dataclass(frozen=True)
class Judged:
    """An object of the winning scene whose pose is to be judged."""

    label: str
    T_camera_object: Floats
    """3 x 4 or 4 x 4."""
    confidence: float
    """The detector's."""
    rivals: tuple[Rival, ...] = ()
    """Other poses that the estimator considered."""
    box: Floats | None = None
    """The detector's, x0, y0, x1, y1 in pixels; None where there was none."""
    sunk: float = 0.0
    """How far its lowest point lies below the plane, metres."""
    penetration: float = 0.0
    """How deep it and another object reach into each other, metres."""


@dataclass(frozen=True)
class Evidence:
    """What the image says of one object's pose."""

    margin: float
    """Log-odds of the estimate, and all that counts as the same, against all other poses that were compared."""
    fit: float
    """Mean distance over the pixels that show it, metres, bounded."""
    shown: float
    """Readings that show it, at the common detail."""
    visible: float
    """Share of the silhouette that nothing hides."""
    gain: float
    """Mean cost per shown reading that the object saves, as a share of the bound; below 0 where it costs."""
    looked_through: float
    spread_metres: float
    spread_radians: float
    breadth: float
    """Spread of the tempered likelihood relative to what counts as right, before it is scaled to that of the errors."""
    hypothesis: float
    """Probability of the scene's hypothesis."""
    confidence: float
    sunk: float = 0.0
    """How far its lowest point lies below the plane, metres."""
    penetration: float = 0.0
    """How deep it and another object reach into each other, metres."""
    unexplained: float = 0.0
    """Share of the foreground readings in its box that no object of the scene explains."""
    noise: float = ORDINARY_NOISE
    """How far readings of the plane lie from it, metres."""

    def features(self) -> Floats:
        """The numbers that :data:`FEATURES` names."""
        odds = np.clip(self.hypothesis, 1e-4, 1 - 1e-4)
        return np.array([
            np.clip(self.margin, -_CAP, _CAP),
            np.log(max(self.fit, 5e-4) / self.noise),
            np.log(max(self.shown, 10.0)),
            np.clip(self.gain, -1.0, 1.0),
            self.looked_through,
            np.log(np.clip(self.breadth, 1e-2, 10.0)),
            np.log(odds / (1 - odds)),
            self.confidence,
            self.unexplained,
            min(self.sunk, _DEEPEST) / RIGHT_METRES,
            min(self.penetration, _DEEPEST) / RIGHT_METRES,
        ])  # fmt: skip


@dataclass(frozen=True)
class Others:
    """Poses that explain the image about as well as the estimate."""

    poses: Floats
    """A x 3 x 4, likeliest first."""
    weights: Floats
    """Of each, relative to the estimate's own."""


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
    unknown: tuple[Region, ...]


def cost_of_an_object(scene: ObservedScene, objects: int) -> float:
    """What it costs to leave an object of ordinary size in the image unexplained, metres times pixels.

    Costs of scenes are compared in these, so that neither the image's resolution nor the objects' size matters.
    """
    return CostForm().truncation * max(1.0, float(scene.foreground.sum()) / max(1, objects))


def hypothesis_probabilities(log_weights: Floats, nat: float) -> Floats:
    """Probability of each hypothesis, summing to 1; ``nat`` is the difference of log-weights that is one nat.

    ``log_weights`` are minus the costs of equation 9, metres times pixels.
    """
    weights = np.exp((log_weights - log_weights.max()) / nat)
    return weights / weights.sum()


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
        self._models: dict[str, _Model] = {}

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
        return SceneDoubt(probabilities, doubts, unknown_regions(scene, layers))

    def evidence(
        self, scene: ObservedScene, objects: Sequence[Judged], layers: Sequence[Float32s], hypothesis: float
    ) -> list[tuple[Evidence, Others]]:
        """What the image says of each object's pose; ``hypothesis`` is the probability of the scene's."""
        noise, lonely = noise_of(scene), _unexplained(scene, layers)
        found: list[tuple[Evidence, Others]] = []
        for i, item in enumerate(objects):
            others = np.maximum.reduce([scene.plane_inverse, *layers[:i], *layers[i + 1 :]])
            T = np.array(item.T_camera_object[:3], float)
            look = _Look(scene, self._model(item.label), T, layers[i], others)
            evidence, rest = look.evidence(item, self._calibration, hypothesis)
            found.append((replace(evidence, noise=noise, unexplained=_share(lonely, scene, item.box)), rest))
        return found

    def layers(self, scene: ObservedScene, objects: Sequence[Judged]) -> list[Float32s]:
        """The inverse depth of each object alone, H x W."""
        return [inverse_depth(self._model(o.label).shape.soup, o.T_camera_object, scene.view) for o in objects]

    def _model(self, label: str) -> _Model:
        if label not in self._models:
            self._models[label] = _Model(self._catalogue[label], self._dof)
        return self._models[label]


def _doubt(evidence: Evidence, others: Others, constants: Calibration) -> PoseDoubt:
    """Alternatives keep their odds against the estimate, but share no more than what it leaves to 1."""
    probability = constants.probability(evidence.features())
    shares = probability * others.weights
    shares *= min(1.0, (1.0 - probability) / max(float(shares.sum()), 1e-9))
    contradicted = is_contradicted(evidence.looked_through)
    return PoseDoubt(evidence, probability, others.poses, tuple(shares.tolist()), contradicted)


class _Model:
    """What is known of one catalogue object."""

    def __init__(self, item: CatalogueObject, dof: Dof) -> None:
        self.shape = Shape.of(item.simplified(500))
        self.proposals = Proposals.of(item, dof)
        self.symmetries = item.symmetries.transforms()
        self.dof: Dof = dof
        self.normals = np.random.default_rng(0).normal(size=(_NEARBY * len(_SCALES), 6))
        """The same noise for every object: what is compared differs in the image alone."""


class _Look:
    """One object under comparison with other poses of it, everything else in its place."""

    def __init__(self, scene: ObservedScene, model: _Model, pose: Floats, layer: Float32s, others: Float32s) -> None:
        self._scene = scene
        self._model = model
        self._pose = pose
        self._layer = layer
        self._others = others
        self._likelihood = _likelihood(scene, model.shape, pose, others)
        self._directions = model.proposals.directions(scene.T_camera_table)

    def evidence(self, item: Judged, constants: Calibration, hypothesis: float) -> tuple[Evidence, Others]:
        """Everything the image says of the pose, and of others."""
        unit = _PIXEL * constants.pose_scale
        own = float(self._likelihood.costs(self._pose[None])[0])
        probes = self._probes(item.rivals)
        nats = (self._likelihood.costs(probes) - own) / unit
        for rival in item.rivals:
            nats[self._is_same(probes, rival.T_camera_object)] = rival.nats
        nats = np.clip(nats, -_CAP, 50.0)
        angles, metres = self._apart(probes)
        away = self._is_away(probes)
        near_metres, near_radians = self._spread(own, unit)
        wide_metres, wide_radians = _profile(nats, metres, angles)
        cells = self._cells(probes[away], nats[away])
        weights = np.exp(-nats[away][cells])
        likely = (weights >= _LIKELY).sum()
        fit, shown, visible, gain = self._shown(own)
        evidence = Evidence(
            margin=float(-np.log(weights.sum() + np.exp(-_CAP))),
            fit=fit,
            shown=shown,
            visible=visible,
            gain=gain,
            looked_through=looked_through(self._scene, self._layer, self._others),
            spread_metres=max(constants.spread_scale * near_metres, wide_metres),
            spread_radians=max(constants.spread_scale * near_radians, wide_radians),
            breadth=max(max(near_metres, wide_metres) / RIGHT_METRES, max(near_radians, wide_radians) / RIGHT_RADIANS),
            hypothesis=hypothesis,
            confidence=item.confidence,
            sunk=item.sunk,
            penetration=item.penetration,
        )
        kept = cells[: min(likely, _KEPT)]
        return evidence, Others(probes[away][kept], np.minimum(weights[: len(kept)], 1.0))

    def _probes(self, rivals: Sequence[Rival]) -> Floats:
        """Turns about the object's axes (the plane's normal with three degrees of freedom), flips, shifts and
        rivals; the better ones that are not nearly the same refined too."""
        flips = self._model.proposals.all_flips(self._pose, self._scene.T_camera_table)[1:]
        axes = self._scene.T_camera_table[:3, :3] if self._model.dof == 3 else self._pose[:, :3]
        spin = axes.T[2:] if self._model.dof == 3 else axes.T
        slide = axes.T[:2] if self._model.dof == 3 else axes.T
        turns = exp_so3((spin[:, None] * _TURNS[:, None]).reshape(-1, 3))
        shifts = (slide[:, None] * _SHIFTS[:, None]).reshape(-1, 3)
        starts = [flips, self._moved(turns, np.zeros(3)), self._moved(np.eye(3)[None], shifts)]
        probes = np.concatenate([*starts, *(rival.T_camera_object[None] for rival in rivals)])
        away = probes[self._is_away(probes)]
        promising = away[np.argsort(self._likelihood.costs(away), kind="stable")[:_REFINED]]
        refined = self._likelihood.refine(promising, self._directions, steps=4, gate=0.02)
        return np.concatenate([probes, refined])

    def _is_away(self, poses: Floats) -> NDArray[np.bool_]:
        return ~self._is_same(poses, self._pose)

    def _is_same(self, poses: Floats, pose: Floats) -> NDArray[np.bool_]:
        angles, metres = self._between(poses, pose)
        return (angles <= RIGHT_RADIANS) & (metres <= RIGHT_METRES)

    def _spread(self, own: float, unit: float) -> tuple[float, float]:
        """Standard deviations of position and angle under the tempered likelihood, by importance sampling.

        Samples of three nested normal distributions about the estimate are weighted by exp(-nats) over their density.
        """
        normals = self._model.normals[:, : self._directions.shape[1]]
        turning = np.abs(self._directions[:3]).sum(0) > 0
        sizes = np.array([np.where(turning, *scale) for scale in _SCALES])
        steps = normals * np.repeat(sizes, _NEARBY, 0)
        twists = (self._directions * steps[:, None, :]).sum(-1)
        poses = self._moved(exp_so3(twists[:, :3]), twists[:, 3:])
        nats = np.clip((self._likelihood.costs(poses) - own) / unit, -_CAP, 200.0)
        log_weights = -nats - _log_density(steps, sizes)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        angles, metres = self._apart(poses)
        return float(np.sqrt((weights * metres**2).sum())), float(np.sqrt((weights * angles**2).sum()))

    def _cells(self, poses: Floats, nats: Floats) -> NDArray[np.intp]:
        """Indices of poses, the likeliest first, no two of which would count as the same, modulo symmetry."""
        likely = np.flatnonzero(nats < _CAP)
        order = likely[distinct_best(poses[likely], nats[likely], 64, metres=RIGHT_METRES, radians=RIGHT_RADIANS)]
        kept: list[int] = []
        for i in order.tolist():
            if not self._is_same(poses[kept], poses[i]).any():
                kept.append(i)
        return np.asarray(kept, np.intp)

    def _shown(self, own: float) -> tuple[float, float, float, float]:
        """Mean distance and number of readings that show the object, its visible share, and what it saves."""
        scene, form = self._scene, _FORM
        silhouette = self._layer > 0
        behind = scene.factor * (1.0 / np.where(silhouette, self._layer, 1.0) - scene.depth)
        shown = silhouette & (self._layer >= self._others) & (behind <= form.occluder_margin)
        read = shown & (scene.factor > 0)
        distances = np.minimum(np.abs(behind[read]), form.truncation)
        fit = float(distances.mean(dtype=np.float64)) if len(distances) else form.truncation
        count = float(len(distances) / self._stride**2)
        gain = float((self._likelihood.base - own) / (form.truncation * max(1.0, count)))
        return fit, count, float(shown.sum() / max(1, silhouette.sum())), gain

    @property
    def _stride(self) -> float:
        return self._scene.view.fx / self._likelihood.window.view.fx

    def _moved(self, turns: Floats, shifts: Floats) -> Floats:
        """The pose after turns about the object's centre and shifts, both in the camera frame."""
        rotations = compose(turns, self._pose[None, :, :3])
        centre = rotate(self._pose[:, :3], self._model.shape.centre) + self._pose[:, 3] + shifts
        offsets = centre - rotate(rotations, self._model.shape.centre)
        rotations = np.broadcast_to(rotations, (len(offsets), 3, 3))
        return np.concatenate([rotations, offsets[..., None]], -1)

    def _apart(self, poses: Floats) -> tuple[Floats, Floats]:
        return self._between(poses, self._pose)

    def _between(self, poses: Floats, pose: Floats) -> tuple[Floats, Floats]:
        """Angle modulo symmetry and distance of the centres between poses (P x 3 x 4) and one pose."""
        centre = self._model.shape.centre
        angles = symmetry_angle(poses[:, :, :3], pose[None, :, :3], self._model.symmetries)
        offsets = rotate(poses[:, :, :3], centre) + poses[:, :, 3] - rotate(pose[:, :3], centre) - pose[:, 3]
        return angles, np.sqrt((offsets**2).sum(-1))


def _likelihood(scene: ObservedScene, shape: Shape, pose: Floats, others: Float32s) -> ObjectLikelihood:
    """Costs of poses about one pose; the window holds the object however it is turned."""
    centre = rotate(pose[:, :3], shape.centre) + pose[:, 3]
    z = max(float(centre[2]), 0.1)
    apparent = shape.diameter / z * scene.view.fx
    u, v = scene.view.project(np.array([centre[0], centre[1], z])).tolist()
    reach = 0.55 * apparent + 0.05 / z * scene.view.fx
    x0, x1 = _span(u, reach, scene.view.width)
    y0, y1 = _span(v, reach, scene.view.height)
    region = (x0, y0, x1, y1)
    stride = max(1, int(apparent / _DETAIL))
    return ObjectLikelihood(shape, Window.of(scene, others, region, region, stride=stride, form=_FORM), scene, _FORM)


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


def _span(middle: float, reach: float, size: int) -> tuple[int, int]:
    first = int(np.clip(np.floor(middle - reach), 0, size - 2))
    return first, int(np.clip(np.ceil(middle + reach), first + 2, size))


def _profile(nats: Floats, metres: Floats, angles: Floats) -> tuple[float, float]:
    """Root mean squares of distance and angle over the probes about the estimate and itself, by weight.

    What is farther away is an alternative, not spread.
    """
    about = (angles < _ABOUT[0]) & (metres < _ABOUT[1])
    nats, metres, angles = nats[about], metres[about], angles[about]
    weights = np.append(np.exp(-np.maximum(nats, 0.0)), 1.0)
    weights /= weights.sum()
    squares = np.stack([np.append(metres, 0.0) ** 2, np.append(angles, 0.0) ** 2])
    mean = (weights * squares).sum(1)
    return float(np.sqrt(mean[0])), float(np.sqrt(mean[1]))


def _log_density(steps: Floats, sizes: Floats) -> Floats:
    """Logarithm, up to a constant, of the density of steps (N x D) in a mixture of normals (K x D deviations)."""
    exponents = -0.5 * ((steps[:, None] / sizes) ** 2).sum(-1) - np.log(sizes).sum(-1)
    top = exponents.max(1, keepdims=True)
    return (np.log(np.exp(exponents - top).sum(1, keepdims=True)) + top)[:, 0]
