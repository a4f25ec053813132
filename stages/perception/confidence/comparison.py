"""One object of a scene compared with other poses of it: what the image says for it, and how far it leaves it open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.poses import compose, exp_so3, rotate, symmetry_angle
from stages.perception.confidence.calibration import RIGHT_METRES, RIGHT_RADIANS, Calibration
from stages.perception.confidence.evidence import CAP, Evidence, Judged, Others, Rival
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.filter.proposals import Dof, Proposals, distinct_best
from stages.perception.hypotheses.unexplained import looked_through
from stages.perception.rendering.rasteriser import Float32s
from stages.scene.catalogue import CatalogueObject

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


class Model:
    """What is known of one catalogue object."""

    def __init__(self, item: CatalogueObject, dof: Dof) -> None:
        self.shape = Shape.of(item.simplified(500))
        self.proposals = Proposals.of(item, dof)
        self.symmetries = item.symmetries.transforms()
        self.dof: Dof = dof
        self.normals = np.random.default_rng(0).normal(size=(_NEARBY * len(_SCALES), 6))
        """The same noise for every object: what is compared differs in the image alone."""


class Comparison:
    """One object under comparison with other poses of it, everything else in its place."""

    def __init__(self, scene: ObservedScene, model: Model, pose: Floats, layer: Float32s, others: Float32s) -> None:
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
        nats = np.clip(nats, -CAP, 50.0)
        angles, metres = self._apart(probes)
        away = self._is_away(probes)
        near_metres, near_radians = self._spread(own, unit)
        wide_metres, wide_radians = _profile(nats, metres, angles)
        cells = self._cells(probes[away], nats[away])
        weights = np.exp(-nats[away][cells])
        likely = (weights >= _LIKELY).sum()
        fit, shown, visible, gain = self._shown(own)
        evidence = Evidence(
            margin=float(-np.log(weights.sum() + np.exp(-CAP))),
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
        nats = np.clip((self._likelihood.costs(poses) - own) / unit, -CAP, 200.0)
        log_weights = -nats - _log_density(steps, sizes)
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        angles, metres = self._apart(poses)
        return float(np.sqrt((weights * metres**2).sum())), float(np.sqrt((weights * angles**2).sum()))

    def _cells(self, poses: Floats, nats: Floats) -> NDArray[np.intp]:
        """Indices of poses, the likeliest first, no two of which would count as the same, modulo symmetry."""
        likely = np.flatnonzero(nats < CAP)
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
