"""Refines the winning scene: every object polished against all others at full resolution, flips settled by colour.

The filters of the hypotheses look at coarse windows and simplified meshes, one object after the other. What follows
is done once, for the winner alone, with finer meshes and every pixel. A pose changes only where the cost of the whole
scene (equation 9) agrees, or where depth hardly tells two poses apart and the photograph does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.poses import rotation_angle, symmetry_angle, turned_within
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.filter.particle_filter import Rectangle
from stages.perception.filter.proposals import Dof, Proposals, plane_directions
from stages.perception.filter.settings import FilterSettings
from stages.perception.hypotheses.composition import fit, scene_cost
from stages.perception.refinement.colour import ColourSettings, load, log_odds
from stages.perception.refinement.contact import Contacts, Solid, apparent, contacts, penalty
from stages.perception.rendering.paint import Paint
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from stages.scene.catalogue import Catalogue, CatalogueObject

_GAIN = 5e-6
"""Metres per visible pixel by which a moved object must lower the scene's cost."""
_SAME = np.deg2rad(12.0)
"""Two poses closer than this, modulo symmetry, are one."""
_ROUGH = 3
_PROMISING = 12
_HOPE = 6.0
"""Steps by which all flips are polished first, and how many are slid; polished in full are only those whose cost then
exceeds the present one's by less than so many times the mean distance of the visible pixels."""
_SLIDES = ((0.012, np.deg2rad(10.0)), (0.005, np.deg2rad(4.0)))
"""Metres and radians by which flips are slid and turned in the image, the greater first."""
_SLIDES_ON_PLANE = ((0.02, np.deg2rad(10.0)), *_SLIDES)
"""The same on the plane."""
_SIDES = np.array(list(product((0.0, -1.0, 1.0), repeat=3)))
"""Every way to turn and slide, staying first, 27 x 3."""
_TURNS = 4
"""Turns by exact symmetries that are polished of each flip."""
_WINDOW = 1.0
"""Colour is asked about poses that cost at most this share of the mean distance more, for each visible pixel."""
_NATS = 3.0
"""What a pose that costs as much more as all that the best one leaves is less likely: sensors' errors are no noise that
many pixels average out."""
_YAW_STEP = np.deg2rad(10.0)
"""Between the turns about a continuous axis at which an object is compared with the photograph."""
_UPRIGHT = 0.9
"""Cosine of the angle to the vertical below which a turn would lay an upright object down."""
_ON_ITS_HEAD = 2.0
"""Nats by which it is less likely that an object stands upside down: where little of it shows, nothing else tells."""
_TIE = 0.01
"""Nats of difference that are rounding: of turns that look the same the object keeps the one that it has."""
_FACING = np.deg2rad(15.0)
"""Turns within this show the same side."""


@dataclass(frozen=True, kw_only=True)
class RefinementSettings:
    """How the winner is refined."""

    dof: Dof = 6
    cost: CostForm = field(default_factory=CostForm)
    triangles: int = 2000
    """Detail of the meshes."""
    rounds: int = 3
    """Times that every object is polished at most, the others fixed; 0 leaves the poses where they are."""
    steps: int = 6
    """Gauss-Newton steps of a polish."""
    gate: float = 0.01
    """Metres between a reading and the surface beyond which it takes no part in a polish."""
    contact: bool = True
    """Penetration and floating cost."""
    colour: bool = True
    """The photograph has a say between poses that depth hardly tells apart, and turns symmetric objects."""
    reading: ColourSettings = field(default_factory=ColourSettings)
    """How the photograph is read."""

    @staticmethod
    def of(filter_settings: FilterSettings) -> RefinementSettings:
        """As the filter is set: what is switched off there is switched off here."""
        chosen = filter_settings
        rounds = RefinementSettings.rounds if chosen.joint else 0
        return RefinementSettings(
            dof=chosen.dof, cost=chosen.cost, rounds=rounds, contact=chosen.contact, colour=chosen.colour
        )


@dataclass(frozen=True)
class Placed:
    """An object of the scene as it was estimated."""

    label: str
    T_camera_object: Floats
    """3 x 4 or 4 x 4."""


@dataclass(frozen=True)
class Considered:
    """A pose that was compared with its flips, the other objects fixed."""

    T_camera_object: Floats
    """3 x 4."""
    nats: float
    """Log-odds of the chosen pose against it, by depth and colour."""


@dataclass(frozen=True)
class RefinedObject:
    """One object of the refined scene."""

    label: str
    T_camera_object: Floats
    """3 x 4."""
    layer: Float32s
    """H x W inverse depth of the object alone."""
    cost: float
    """Mean distance over the pixels that show it, metres, bounded."""
    visible: float
    """Share of its silhouette that nothing hides."""
    considered: tuple[Considered, ...]
    """The other poses that depth hardly tells from the chosen one, modulo symmetry, the likeliest first."""
    facing: float | None
    """How likely it faces as the pose says, if that is right modulo symmetry; None without symmetries or colour."""
    penetration: float = 0.0
    """How deep it and another object reach into each other, metres."""
    sunk: float = 0.0
    """How far its lowest point lies below the plane, metres."""


@dataclass(frozen=True)
class RefinedScene:
    """The winner, refined."""

    objects: tuple[RefinedObject, ...]
    cost: float
    """d(R, O) of equation 9 over the whole image, metres times pixels."""


class SceneRefiner:
    """Refines scenes of one catalogue's objects."""

    def __init__(self, catalogue: Catalogue, settings: RefinementSettings) -> None:
        self._catalogue = catalogue
        self._settings = settings
        self._models: dict[str, _Model] = {}

    def warm_up(self) -> None:
        """Lays out every mesh and compiles the kernels (or loads them); solids and paint wait until they are needed."""
        for label in self._catalogue.objects:
            self._model(label)
        T_camera_table = np.diag([1.0, -1.0, -1.0, 1.0])
        T_camera_table[2, 3] = 1.1
        depth = np.full((48, 64), 1.1, np.float32)
        K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
        scene = ObservedScene.of(depth, depth > 2, K, T_camera_table)
        placed = [Placed(next(iter(self._catalogue.objects)), T_camera_table)] * 2
        self.refine(scene, np.zeros((48, 64, 3), np.uint8), placed)
        if self._settings.colour:
            # So small an image is not looked at.
            self._model(placed[0].label).paint.drawn(T_camera_table[:3], scene.view)
            load()

    def refine(self, scene: ObservedScene, rgb: NDArray[np.uint8], placed: Sequence[Placed]) -> RefinedScene:
        """Polishes all objects together and settles flips; ``rgb`` is H x W x 3, sRGB, registered to the depth."""
        poses = [np.array(item.T_camera_object[:3], float) for item in placed]
        joint = _Joint(scene, [self._model(item.label) for item in placed], poses, self._settings)
        joint.polish()
        joint.settle(rgb)
        return joint.result()

    def _model(self, label: str) -> _Model:
        if label not in self._models:
            self._models[label] = _Model(self._catalogue[label], self._settings)
        return self._models[label]


class _Model:
    """What the refiner knows of one catalogue object."""

    def __init__(self, item: CatalogueObject, settings: RefinementSettings) -> None:
        self.label = item.name
        self.item = item
        self.shape = Shape.of(item.simplified(settings.triangles))
        self.proposals = Proposals.of(item, settings.dof)
        turns = item.symmetries.transforms(_YAW_STEP)
        self.turns = turns if settings.dof == 6 else turns[turns[:, 2, 2] > _UPRIGHT]
        """Exact symmetries, of which depth knows nothing, identity first."""

    @cached_property
    def solid(self) -> Solid:
        """For contacts."""
        return Solid.of(self.item)

    @cached_property
    def paint(self) -> Paint:
        """The full mesh with its colours."""
        return Paint.of(self.item.mesh)


@dataclass(frozen=True)
class _Place:
    """One object's surroundings while all others stay where they are."""

    region: Rectangle
    likelihood: ObjectLikelihood
    directions: Floats
    visible: float
    """Pixels that show the object."""
    misfit: float
    """What the present pose leaves of these pixels' readings, metres times pixels."""


class _Joint:
    """All objects of a scene while they are refined."""

    def __init__(
        self, scene: ObservedScene, models: list[_Model], poses: list[Floats], settings: RefinementSettings
    ) -> None:
        self._scene = scene
        self._models = models
        self._poses = poses
        self._settings = settings
        self._layers = [self._layer(i) for i in range(len(models))]
        self._considered: list[tuple[Considered, ...]] = [()] * len(models)
        self._facing: list[float | None] = [None] * len(models)

    def polish(self) -> None:
        """Moves one object after the other, the others fixed, until a whole round changes nothing."""
        stale = set(range(len(self._models)))
        for _ in range(self._settings.rounds):
            moved = {i for i in sorted(stale) if self._polish(i)}
            stale = {j for i in moved for j in range(len(self._models)) if self._touches(i, j)}

    def settle(self, rgb: NDArray[np.uint8]) -> None:
        """Chooses between each object's flips, by depth and colour, and polishes again if any turned."""
        turned = [self._settle(i, rgb) for i in range(len(self._models))]
        if any(turned):
            self.polish()

    def result(self) -> RefinedScene:
        """The scene as it stands."""
        touching = contacts([model.solid for model in self._models], np.reshape(self._poses, (-1, 3, 4)),
                            self._scene.T_camera_table)  # fmt: skip
        found = tuple(self._found(i, touching) for i in range(len(self._models)))
        return RefinedScene(found, scene_cost(self._scene, self._layers, self._settings.cost))

    def _polish(self, i: int) -> bool:
        place, start = self._place(i), self._poses[i][None]
        moved = place.likelihood.refine(start, place.directions, steps=self._settings.steps, gate=self._settings.gate)
        before, after = self._totals(i, place, np.concatenate([start, moved])).tolist()
        better = after < before - _GAIN * place.visible
        if better:
            self._move(i, moved[0])
        return better

    def _settle(self, i: int, rgb: NDArray[np.uint8]) -> bool:
        """Moves an object to the likeliest of its flips and symmetric turns; whether its shape moved."""
        place = self._place(i)
        poses, odds = self._contenders(i, place)
        faced = turned_within(poses, self._models[i].turns)
        ups = faced[:, :, :3, 2] @ self._scene.T_camera_table[:3, 2]
        odds = odds[:, None] + self._colours(i, place, faced, rgb) - _ON_ITS_HEAD * (ups < -_UPRIGHT)
        flip, turn = divmod(int(np.argmax(odds > odds.max() - _TIE)), faced.shape[1])
        shape_moved = not np.array_equal(poses[flip], self._poses[i])
        self._move(i, faced[flip, turn])
        self._considered[i] = _considered(poses, odds.max(1), flip)
        if self._settings.colour and faced.shape[1] > 1:
            self._facing[i] = _facing(faced[flip], odds[flip], turn)
        return shape_moved

    def _contenders(self, i: int, place: _Place) -> tuple[Floats, Floats]:
        """Poses that depth hardly tells apart, its favourite first, A x 3 x 4, and what it says for each, nats.

        They are the present pose and its polished flips, no two the same modulo the object's symmetries.
        """
        present = self._poses[i][None]
        poses = self._best_turns(i, place, np.concatenate([present, self._flips(i, place)]))
        most = place.likelihood.costs(present) + _WINDOW * place.misfit
        poses = poses[place.likelihood.costs(poses) <= most]
        totals = self._totals(i, place, poses)
        kept = _distinct(poses, totals, self._models[i].item.symmetries.transforms())
        excess = (totals[kept] - totals.min()) / place.misfit
        return poses[kept][excess <= _WINDOW], -_NATS * excess[excess <= _WINDOW]

    def _best_turns(self, i: int, place: _Place, poses: Floats) -> Floats:
        """Each pose after that of the object's exact symmetries which costs least once polished.

        A scanned mesh is symmetric but for some tenths of a millimetre, and by as much two flips may differ.
        """
        turned, rows = turned_within(poses, self._models[i].turns), np.arange(len(poses))[:, None]
        costs = place.likelihood.costs(turned.reshape(-1, 3, 4)).reshape(turned.shape[:2])
        turned = turned[rows, np.argsort(costs, 1, kind="stable")[:, :_TURNS]].reshape(-1, 3, 4)
        polished = place.likelihood.refine(
            turned, place.directions, steps=self._settings.steps, gate=self._settings.gate
        )
        ways = np.concatenate([poses[:, None], np.stack([turned, polished], 1).reshape(len(poses), -1, 3, 4)], 1)
        costs = place.likelihood.costs(ways.reshape(-1, 3, 4)).reshape(ways.shape[:2])
        costs[:, 0] -= _GAIN * place.visible
        return ways[rows[:, 0], costs.argmin(1)]

    def _flips(self, i: int, place: _Place) -> Floats:
        """Those of the object's flips that are worth a full polish, polished."""
        settings, T_camera_table = self._settings, self._scene.T_camera_table
        flips = self._models[i].proposals.all_flips(self._poses[i], T_camera_table)[1:]
        rough = _improved(place, flips, steps=_ROUGH, gate=2 * settings.gate)
        in_image = place.directions[:, 2:5] if settings.dof == 6 else place.directions
        slid = np.concatenate([
            self._slid(i, place, rough, in_image, _SLIDES),
            self._slid(i, place, flips, plane_directions(T_camera_table), _SLIDES_ON_PLANE),
        ])  # fmt: skip
        most = place.likelihood.costs(self._poses[i][None]) + _HOPE * place.misfit
        promising = slid[place.likelihood.costs(slid) < most]
        return _improved(place, promising, steps=settings.steps, gate=settings.gate)

    def _slid(
        self, i: int, place: _Place, poses: Floats, ways: Floats, slides: Sequence[tuple[float, float]]
    ) -> Floats:
        """The best of the poses, slid and turned the given ways where that costs less.

        A polish sees surfaces but no outlines: what is flat would stay beside where it lies, and of a box of which one
        end shows, a quarter turn about its middle moves that end.
        """
        poses = poses[np.argsort(place.likelihood.costs(poses), kind="stable")[:_PROMISING]]
        for metres, radians in slides:
            steps = _SIDES * np.where(np.abs(ways[:3]).sum(0) > 0, radians, metres)
            twists = np.tile((ways * steps[:, None]).sum(-1), (len(poses), 1))
            around = self._models[i].proposals.moved(np.repeat(poses, len(_SIDES), 0), twists)
            best = place.likelihood.costs(around).reshape(-1, len(_SIDES)).argmin(1)
            poses = around.reshape(-1, len(_SIDES), 3, 4)[np.arange(len(poses)), best]
        return poses

    def _colours(self, i: int, place: _Place, faced: Floats, rgb: NDArray[np.uint8]) -> Floats:
        """What the photograph says for each of A x S poses, nats."""
        if not self._settings.colour:
            return np.zeros(faced.shape[:2])
        x0, y0, x1, y1 = place.region
        window, model = place.likelihood.window, self._models[i]
        layers = [inverse_depth(model.shape.soup, T, window.view) for T in faced[:, 0]]
        shown = np.logical_or.reduce([_shown(window, layer, self._settings.cost) for layer in layers])
        poses, reading = faced.reshape(-1, 3, 4), self._settings.reading
        found = log_odds(rgb[y0:y1, x0:x1], window.view, shown, poses, paint=model.paint, settings=reading)
        return found.reshape(faced.shape[:2])

    def _place(self, i: int) -> _Place:
        """Costs of poses of one object about where it is, with all others fixed, at full resolution.

        Credit is given everywhere, so that costs differ by as much as the scene's.
        """
        x0, y0, x1, y1 = region = _around(self._models[i].shape, self._poses[i], self._scene)
        scene = _cropped(self._scene, region)
        others = [layer[y0:y1, x0:x1] for j, layer in enumerate(self._layers) if j != i]
        background = np.maximum.reduce([scene.plane_inverse, *others])
        everything = (0, 0, x1 - x0, y1 - y0)
        window = Window.of(scene, background, everything, everything, stride=1, form=self._settings.cost)
        likelihood = ObjectLikelihood(self._models[i].shape, window, scene, self._settings.cost)
        layer = self._layers[i][y0:y1, x0:x1]
        cost, share = fit(scene, layer, background, self._settings.cost)
        visible = float(share * (layer > 0).sum())
        directions = self._models[i].proposals.directions(scene.T_camera_table)
        return _Place(region, likelihood, directions, visible, cost * max(1.0, visible))

    def _totals(self, i: int, place: _Place, poses: Floats) -> Floats:
        """What the scene costs with the object at each of the poses, up to a constant: depth and contact."""
        return place.likelihood.costs(poses) + np.array([self._penalty(i, pose) for pose in poses])

    def _penalty(self, i: int, pose: Floats) -> float:
        if not self._settings.contact:
            return 0.0
        solids = [model.solid for model in self._models]
        poses = np.stack([*self._poses[:i], pose, *self._poses[i + 1 :]])
        found = contacts(solids, poses, self._scene.T_camera_table)
        return penalty(found, apparent(solids, poses, self._scene.view.fx))

    def _found(self, i: int, touching: Contacts) -> RefinedObject:
        others = [self._scene.plane_inverse, *(layer for j, layer in enumerate(self._layers) if j != i)]
        cost, visible = fit(self._scene, self._layers[i], np.maximum.reduce(others), self._settings.cost)
        return RefinedObject(
            self._models[i].label, self._poses[i], self._layers[i], cost, visible, self._considered[i], self._facing[i],
            penetration=float(touching.penetration[i].max()), sunk=float(touching.sunk[i]),
        )  # fmt: skip

    def _move(self, i: int, pose: Floats) -> None:
        self._poses[i] = pose
        self._layers[i] = self._layer(i)

    def _layer(self, i: int) -> Float32s:
        return inverse_depth(self._models[i].shape.soup, self._poses[i], self._scene.view)

    def _touches(self, i: int, j: int) -> bool:
        """Whether another object stands near enough for its pose to depend on this one's."""
        a, b = (_around(self._models[k].shape, self._poses[k], self._scene) for k in (i, j))
        return i != j and a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _improved(place: _Place, poses: Floats, *, steps: int, gate: float) -> Floats:
    """Poses polished where that lowers their cost: a polish sees surfaces but no outlines."""
    polished = place.likelihood.refine(poses, place.directions, steps=steps, gate=gate)
    better = place.likelihood.costs(polished) < place.likelihood.costs(poses)
    return np.where(better[:, None, None], polished, poses)


def _distinct(poses: Floats, ranks: Floats, symmetries: Floats) -> list[int]:
    """The poses by rank, without those that equal one before modulo symmetry."""
    kept: list[int] = []
    for k in np.argsort(ranks, kind="stable").tolist():
        if all(symmetry_angle(poses[j, :, :3], poses[k, :, :3], symmetries) > _SAME for j in kept):
            kept.append(k)
    return kept


def _considered(poses: Floats, odds: Floats, chosen: int) -> tuple[Considered, ...]:
    order = [k for k in np.argsort(-odds, kind="stable").tolist() if k != chosen]
    return tuple(Considered(poses[k], float(odds[chosen] - odds[k])) for k in order)


def _facing(faced: Floats, odds: Floats, chosen: int) -> float:
    """The share of the likelihood that shows the chosen side, of the turns S x 3 x 4 of one pose."""
    weights = np.exp(odds - odds.max())
    same = rotation_angle(faced[:, :, :3], faced[chosen, :, :3]) <= _FACING
    return float(weights[same].sum() / weights.sum())


def _shown(window: Window, layer: Float32s, form: CostForm) -> NDArray[np.bool_]:
    """Where an object at a pose can be seen: nothing known and no reading lies in front of it."""
    behind = window.factor * (1.0 / np.where(layer > 0, layer, 1.0) - window.observed)
    return (layer > window.inverse_background) & ~(behind > form.occluder_margin)


def _around(shape: Shape, pose: Floats, scene: ObservedScene) -> Rectangle:
    """The part of the image that the object's enclosing sphere may cover, whatever its orientation; never empty."""
    centre = (pose[:, :3] * shape.centre).sum(-1) + pose[:, 3]
    z = max(float(centre[2]), 0.1)
    u, v = scene.view.project(np.array([centre[0], centre[1], z]))
    reach = 0.55 * shape.diameter / z * scene.view.fx + 8
    x0, x1 = _span(float(u), reach, scene.view.width)
    y0, y1 = _span(float(v), reach, scene.view.height)
    return x0, y0, x1, y1


def _span(middle: float, reach: float, size: int) -> tuple[int, int]:
    first = int(np.clip(np.floor(middle - reach), 0, size - 2))
    return first, int(np.clip(np.ceil(middle + reach), first + 2, size))


def _cropped(scene: ObservedScene, region: Rectangle) -> ObservedScene:
    x0, y0, x1, y1 = region
    part = np.s_[y0:y1, x0:x1]
    return ObservedScene(
        scene.view.sampled(*region, 1), scene.depth[part], scene.factor[part], scene.foreground[part],
        scene.plane_inverse[part], scene.leeway[part], scene.T_camera_table,
    )  # fmt: skip
