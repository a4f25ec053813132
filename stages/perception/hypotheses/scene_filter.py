"""Estimates all objects of one hypothesised scene, and weighs the result."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.masks import opened
from stages.messages.digest import DepthPatch
from stages.perception.filter.iterations import CPU, Device
from stages.perception.filter.likelihood import ObservedScene, with_object
from stages.perception.filter.particle_filter import ObjectFilter, Task, Track, pixels, run_together
from stages.perception.filter.settings import FilterSettings
from stages.perception.hypotheses.composition import Composition, claim, fit, glimpse, rise, scene_cost
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from stages.scene.catalogue import Catalogue

_IDLE = 0.05
"""An object explains nothing if it lowers the cost of the scene by a smaller share."""
_LEFT = 0.1
"""An object in whose box a smaller share of what stands there is unexplained has nothing to gain from another visit."""
_ASTRAY = 0.05
"""An object that explains nothing, though a larger share of what stands in its box is unexplained, is sought anew."""
_OPEN = 0.006
"""A reading is unexplained if it costs more, metres: noise and the edges of simplified meshes stay below."""
_THIN = 1 / 256
"""Half of how thin, in widths of the image, unexplained readings are where a silhouette lies beside its edge in the
depth image: edges fray, and a sensor whose depth is 2 % too long shows a tray 8 mm longer than it is."""


@dataclass(frozen=True)
class Suspect:
    """A candidate as the filter sees it."""

    label: str
    box: Floats
    """x0, y0, x1, y1 in pixels; the object is sought here."""
    others: tuple[Floats, ...] = ()
    """Boxes that may frame the same object: a detector sometimes frames one object twice, its top and its front."""


@dataclass(frozen=True)
class Found:
    """One object of an estimated scene."""

    track: Track
    cost: float
    """Mean distance over the pixels that show it, metres (bounded where the form is)."""
    visible: float
    """Share of its silhouette that nothing hides."""


@dataclass(frozen=True)
class SceneResult:
    """The most likely scene of one hypothesis."""

    objects: tuple[Found, ...]
    cost: float
    """d(R, O) of equation 9 over the whole image, metres times pixels at full resolution."""
    dropped: bool = False
    """The hypothesis cannot win: ``cost`` is a lower bound of what its scenes cost, and the objects stand where the
    first look saw them."""
    unexplained: tuple[float, ...] = ()
    """Of each box that was asked about: the share of what stands in it that the scene leaves unexplained."""
    layers: tuple[Float32s, ...] = ()
    """Inverse depth of each object alone, H x W."""


class SceneFilter:
    """Estimates the objects of hypothesised scenes.

    Where objects are visited again once all are known, each candidate is looked at alone first. That look depends on
    the observation and the candidate only, so all hypotheses share it; what follows is particular to the hypothesis.
    The paper's plain form estimates one object after the other instead, those before it fixed; there seeds come from
    the candidates up to the object, so hypotheses that begin alike share those objects' estimates. The last ``memory``
    tracks are remembered either way, which saves time and changes no byte.
    """

    def __init__(
        self, catalogue: Catalogue, settings: FilterSettings, *, device: Device = CPU, seed: int = 0, memory: int = 256
    ) -> None:
        self._catalogue = catalogue
        self._settings = settings
        self._device = device
        self._seed = seed
        self._memory = memory
        self._filters: dict[str, ObjectFilter] = {}
        self._tracks: OrderedDict[bytes, Track] = OrderedDict()
        self._costs: OrderedDict[bytes, float] = OrderedDict()
        self.runs = 0
        """Filters of one object that have run from first guesses."""
        self.visits = 0
        """Visits to an object that had a pose already."""

    @property
    def looks_first(self) -> bool:
        """Whether hypotheses begin with looks at each candidate alone; the paper's plain form knows none."""
        return self._settings.sweeps > 0

    def warm_up(self) -> None:
        """Lays out every object and compiles the kernels (or loads them), so that the first image waits for nothing."""
        for label in self._catalogue.objects:
            self._filter(label)
        depth = np.ones((12, 16), np.float32)
        K = np.array([[16.0, 0.0, 8.0], [0.0, 16.0, 6.0], [0.0, 0.0, 1.0]])
        T_camera_table = np.eye(4)
        T_camera_table[:3, :3] = np.diag([1.0, -1.0, -1.0])
        T_camera_table[2, 3] = 1.1
        scene = ObservedScene.of(depth, depth > 0, K, T_camera_table)
        suspect = Suspect(next(iter(self._catalogue.objects)), np.array([4.0, 3.0, 12.0, 9.0]))
        brief = replace(self._settings, iterations=2, sweeps=0)
        SceneFilter(self._catalogue, brief, device=self._device).estimate(scene, [suspect])

    def look(self, scene: ObservedScene, suspect: Suspect, *, among: int) -> Track:
        """One candidate alone on the plane; the budget of iterations is divided ``among`` so many."""
        return self.looks(scene, [suspect], among=among)[0]

    def looks(self, scene: ObservedScene, suspects: Sequence[Suspect], *, among: int) -> list[Track]:
        """Looks at several candidates, each alone; on a GPU those that are new are one batch."""
        share = self._settings.iterations // max(1, among)
        alone = _extended_by(self._observation_key(scene, share), b"alone")
        keys = [_extended(alone, suspect) for suspect in suspects]
        new = {key: suspect for key, suspect in zip(keys, suspects, strict=True) if key not in self._tracks}
        tracks = {key: self._tracks[key] for key in keys if key in self._tracks}
        tracks |= self._run_together(scene, new, share)
        for key in new:
            self._remember(key, tracks[key])
        return [tracks[key] for key in keys]

    def glimpse(self, scene: ObservedScene, suspect: Suspect, track: Track, *, anywhere: bool = False) -> DepthPatch:
        """What a track would show, for the first ranking of combinations; ``anywhere`` counts what it explains outside
        its box too."""
        height, width = scene.depth.shape
        box = np.array([0.0, 0.0, width, height]) if anywhere else suspect.box
        return glimpse(scene, self._layer(scene, suspect, track.T_camera_object), box, self._settings.cost)

    def worth(self, scene: ObservedScene, suspect: Suspect, track: Track) -> tuple[float, float, float]:
        """How far a track's object stands out of the plane, metres, what it claims, and the share that it explains."""
        layer = self._layer(scene, suspect, track.T_camera_object)
        return rise(scene, layer, self._settings.cost), *claim(scene, layer, self._settings.cost)

    def estimate(
        self, scene: ObservedScene, suspects: Sequence[Suspect], starts: Sequence[Track] | None = None, *,
        reached: float = np.inf, asked: Sequence[Suspect] = (),
    ) -> SceneResult:  # fmt: skip
        """The most likely scene of the suspects, most confident first.

        ``starts`` are the looks at each alone, taken here where they are not at hand; suspects beyond them are looked
        for one after the other among those before. A scene that costs ``reached`` is known: a hypothesis whose scenes
        all must cost more is dropped, and one that ends above it is not polished. ``asked`` are those whose boxes are
        asked about.
        """
        if not self.looks_first:
            tracks = self._sequence(scene, suspects)
            layers = self._layers(scene, suspects, tracks)
            return self._result(scene, tracks, layers, scene_cost(scene, layers, self._settings.cost))
        begun = list(starts or self.looks(scene, suspects, among=len(suspects)))
        composition = self._composition(scene, suspects)
        if (bound := composition.bound()) > reached:
            return self._result(scene, begun, self._layers(scene, suspects[: len(begun)], begun), bound, dropped=True)
        begun = self._found_among(scene, suspects, begun)
        draft = _Draft(scene, suspects, begun, self._layers(scene, suspects, begun), composition)
        self._settle(draft, reached)
        unexplained = draft.unexplained([_window(scene, suspect) for suspect in asked]) if asked else []
        return replace(self._result(scene, draft.tracks, draft.layers, draft.cost), unexplained=tuple(unexplained))

    def begun_cost(self, scene: ObservedScene, suspects: Sequence[Suspect], starts: Sequence[Floats]) -> float:
        """What the scene of first looks costs, poses 3 x 4; estimating its hypothesis ends no higher."""
        key = self._observation_key(scene, 0)
        for suspect, start in zip(suspects, starts, strict=True):
            key = _extended_by(_extended(key, suspect), b"".join(each.tobytes() for each in (start, *suspect.others)))
        cost = self._costs.get(key)
        if cost is None:
            layers = [self._layer(scene, s, pose) for s, pose in zip(suspects, starts, strict=True)]
            self._costs[key] = cost = self._composition(scene, suspects).cost(layers)
            if len(self._costs) > self._memory:
                self._costs.popitem(last=False)
        return cost

    def _sequence(self, scene: ObservedScene, suspects: Sequence[Suspect]) -> list[Track]:
        share = self._settings.iterations // max(1, len(suspects))
        background = scene.plane_inverse
        key = self._observation_key(scene, share)
        tracks: list[Track] = []
        for suspect in suspects:
            key = _extended(key, suspect)
            tracks.append(self._remembered(key, scene, background, suspect, share))
            background = self._added(background, scene, suspect, tracks[-1])
        return tracks

    def _found_among(self, scene: ObservedScene, suspects: Sequence[Suspect], begun: Sequence[Track]) -> list[Track]:
        """The tracks of all suspects: those beyond the given ones are looked for among those before."""
        tracks = list(begun)
        key = _extended_by(self._observation_key(scene, 0), b"among")
        for track in tracks:
            key = _extended_by(key, track.T_camera_object.tobytes())
        for suspect in suspects[len(begun) :]:
            background = _composite(scene, self._layers(scene, suspects[: len(tracks)], tracks))
            key = _extended(key, suspect)
            tracks.append(self._run(scene, background, suspect, self._settings.iterations // len(suspects), key))
        return tracks

    def _remembered(
        self, key: bytes, scene: ObservedScene, background: Float32s, suspect: Suspect, iterations: int
    ) -> Track:
        track = self._tracks.get(key)
        if track is None:
            track = self._run(scene, background, suspect, iterations, key)
            self._remember(key, track)
        return track

    def _remember(self, key: bytes, track: Track) -> None:
        self._tracks[key] = track
        if len(self._tracks) > self._memory:
            self._tracks.popitem(last=False)

    def _run(self, scene: ObservedScene, background: Float32s, suspect: Suspect, iterations: int, key: bytes) -> Track:
        self.runs += 1
        return run_together(scene, [self._task(scene, background, suspect, key)], iterations=iterations)[0]

    def _run_together(
        self, scene: ObservedScene, suspects: dict[bytes, Suspect], iterations: int
    ) -> dict[bytes, Track]:
        """Each suspect alone on the plane, seeded by its key."""
        self.runs += len(suspects)
        tasks = [self._task(scene, scene.plane_inverse, suspect, key) for key, suspect in suspects.items()]
        return dict(zip(suspects, run_together(scene, tasks, iterations=iterations), strict=True)) if tasks else {}

    def _task(self, scene: ObservedScene, background: Float32s, suspect: Suspect, key: bytes) -> Task:
        return Task(self._filter(suspect.label), background, pixels(suspect.box, scene), _generator(key))

    def _settle(self, draft: _Draft, reached: float) -> None:
        """Visits objects again, the others known, until nothing changes.

        First those in whose boxes something is unexplained, which is what decides between hypotheses. In a scene that
        can win all objects follow: what is explained may be explained better by a flipped pose.
        """
        self._visit(draft, least=_LEFT, first=0)
        if draft.cost <= reached:
            self._visit(draft, least=-np.inf, first=self._settings.sweeps)

    def _visit(self, draft: _Draft, *, least: float, first: int) -> None:
        stale = set(range(len(draft.suspects)))
        for number in range(first, first + self._settings.sweeps):
            rescued = self._rescue(draft) if number == 1 else set[int]()
            left = draft.unexplained(draft.windows)
            stale = self._sweep(draft, rescued | {i for i in stale if left[i] > least}, number)

    def _sweep(self, draft: _Draft, stale: set[int], number: int) -> set[int]:
        """Visits the stale objects with all others known; returns those around which something changed.

        The worst fits come first: an object that alone took another's place must leave before that one is visited.
        """
        keys = self._keys(draft, b"sweep%d" % number)
        fits = {i: fit(draft.scene, draft.layers[i], draft.background(i), self._settings.cost)[0] for i in stale}
        changed: set[int] = set()
        for i in sorted(stale, key=lambda i: (-fits[i], i)):
            self.visits += 1
            box = pixels(draft.suspects[i].box, draft.scene)
            visit = self._filter(draft.suspects[i].label).revisit
            track = visit(draft.scene, draft.background(i), box, draft.tracks[i], rng=_generator(keys[i]))
            if track is not draft.tracks[i]:
                changed |= self._moved(draft, i, track)
        return changed

    def _rescue(self, draft: _Draft) -> set[int]:
        """Starts the filter anew for objects that explain nothing, now that the readings of the others are explained.

        A tray that is looked at alone sees the things that stand on it as readings in front of it, and may hide.
        """
        keys = self._keys(draft, b"rescue")
        share = self._settings.iterations // max(1, len(keys))
        changed: set[int] = set()
        for i, suspect in enumerate(draft.suspects):
            if draft.cost < draft.cost_without(i) * (1 - _IDLE) or draft.unexplained(draft.windows)[i] <= _ASTRAY:
                continue
            track = self._run(draft.scene, draft.background(i), suspect, share, keys[i])
            changed |= self._moved(draft, i, track)
        return changed

    def _moved(self, draft: _Draft, i: int, track: Track) -> set[int]:
        """Takes another track of an object where that lowers the cost; returns the objects into whose boxes it came."""
        layer = self._layer(draft.scene, draft.suspects[i], track.T_camera_object)
        return draft.others_reached(i) if draft.take(i, track, layer) else set()

    def _composition(self, scene: ObservedScene, suspects: Sequence[Suspect]) -> Composition:
        return Composition(scene, self._settings.cost, [(s.box, *s.others) for s in suspects])

    def _result(
        self, scene: ObservedScene, tracks: Sequence[Track], layers: Sequence[Float32s], cost: float, *,
        dropped: bool = False,
    ) -> SceneResult:  # fmt: skip
        return SceneResult(tuple(self._found(scene, tracks, layers)), cost, dropped, layers=tuple(layers))

    def _found(self, scene: ObservedScene, tracks: Sequence[Track], layers: Sequence[Float32s]) -> Iterator[Found]:
        for i, track in enumerate(tracks):
            others = _composite(scene, [*layers[:i], *layers[i + 1 :]])
            yield Found(track, *fit(scene, layers[i], others, self._settings.cost))

    def _keys(self, draft: _Draft, purpose: bytes) -> list[bytes]:
        """One seed an object, from the observation and all of the hypothesis."""
        key = _extended_by(self._observation_key(draft.scene, 0), purpose)
        for suspect in draft.suspects:
            key = _extended(key, suspect)
        return [_extended_by(key, b"%d" % i) for i in range(len(draft.suspects))]

    def _filter(self, label: str) -> ObjectFilter:
        if label not in self._filters:
            self._filters[label] = ObjectFilter(self._catalogue[label], self._settings, device=self._device)
        return self._filters[label]

    def _layers(self, scene: ObservedScene, suspects: Sequence[Suspect], tracks: Sequence[Track]) -> list[Float32s]:
        return [self._layer(scene, s, track.T_camera_object) for s, track in zip(suspects, tracks, strict=True)]

    def _layer(self, scene: ObservedScene, suspect: Suspect, T_camera_object: Floats) -> Float32s:
        return inverse_depth(self._filter(suspect.label).fine.soup, T_camera_object, scene.view)

    def _added(self, background: Float32s, scene: ObservedScene, suspect: Suspect, track: Track) -> Float32s:
        return with_object(background, self._filter(suspect.label).fine.soup, track.T_camera_object, scene.view)

    def _observation_key(self, scene: ObservedScene, share: int) -> bytes:
        digest = hashlib.blake2b(np.array([self._seed, share]).tobytes(), digest_size=16)
        digest.update(scene.depth.tobytes())
        digest.update(scene.T_camera_table.tobytes())
        return digest.digest()


class _Draft:
    """The scene of one hypothesis while it is estimated."""

    def __init__(
        self, scene: ObservedScene, suspects: Sequence[Suspect], tracks: Sequence[Track], layers: list[Float32s],
        composition: Composition,
    ) -> None:  # fmt: skip
        self.scene = scene
        self.suspects = suspects
        self.tracks = list(tracks)
        self.layers = layers
        self.composition = composition
        self.cost = composition.cost(layers)
        self.windows = [_window(scene, suspect) for suspect in suspects]

    def background(self, i: int) -> Float32s:
        """The plane and all objects but one."""
        return _composite(self.scene, self.layers[:i] + self.layers[i + 1 :])

    def others_reached(self, i: int) -> set[int]:
        """The objects into whose boxes the layer of object i reaches, itself among them."""
        return {j for j, window in enumerate(self.windows) if bool((self.layers[i][window] > 0).any())}

    def cost_without(self, i: int) -> float:
        """Cost of the scene without one object."""
        return self.composition.cost_without(i, self.layers)

    def unexplained(self, windows: Sequence[tuple[slice, slice]]) -> list[float]:
        """For every window the share of what stands in it that the scene does not explain."""
        costs, credit = self.composition.pixels(self.layers), self.composition.credit
        left = opened(costs > _OPEN, round(_THIN * costs.shape[1]))
        return [
            float(costs[window][left[window]].sum(dtype=np.float64))
            / max(float(credit[window].sum(dtype=np.float64)), 1e-6)
            for window in windows
        ]

    def take(self, i: int, track: Track, layer: Float32s) -> bool:
        """Moves an object where that lowers the cost of the scene."""
        cost = self.composition.cost([*self.layers[:i], layer, *self.layers[i + 1 :]])
        if cost >= self.cost:
            return False
        self.tracks[i], self.layers[i], self.cost = track, layer, cost
        return True


def _window(scene: ObservedScene, suspect: Suspect) -> tuple[slice, slice]:
    x0, y0, x1, y1 = pixels(suspect.box, scene)
    return np.s_[y0:y1, x0:x1]


def _composite(scene: ObservedScene, layers: Sequence[Float32s]) -> Float32s:
    nearest = scene.plane_inverse.copy()
    for layer in layers:
        np.maximum(nearest, layer, out=nearest)
    return nearest


def _extended(key: bytes, suspect: Suspect) -> bytes:
    return _extended_by(key, suspect.label.encode() + suspect.box.tobytes())


def _extended_by(key: bytes, data: bytes) -> bytes:
    return hashlib.blake2b(key + data, digest_size=16).digest()


def _generator(key: bytes) -> np.random.Generator:
    return np.random.default_rng(int.from_bytes(key, "little"))
