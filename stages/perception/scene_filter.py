"""Estimates all objects of one hypothesised scene, and weighs the result."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.perception.likelihood import CostForm, ObservedScene, credits, with_object
from stages.perception.particle_filter import FilterSettings, ObjectFilter, Track, pixels
from stages.perception.rasteriser import Float32s, inverse_depth
from stages.scene.catalogue import Catalogue, Floats

_IDLE = 0.01
"""An object explains nothing if it lowers the cost of the scene by a smaller share."""


@dataclass(frozen=True)
class Suspect:
    """A candidate as the filter sees it."""

    label: str
    box: Floats
    """x0, y0, x1, y1 in pixels."""


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


class SceneFilter:
    """The sequential filter over the objects of a hypothesis.

    Seeds come from the observation and the candidates up to the object, so two hypotheses that begin alike share
    those objects' estimates; the last ``memory`` of these are remembered, which saves time and changes no byte.
    """

    def __init__(self, catalogue: Catalogue, settings: FilterSettings, *, seed: int = 0, memory: int = 256) -> None:
        self._catalogue = catalogue
        self._settings = settings
        self._seed = seed
        self._memory = memory
        self._filters: dict[str, ObjectFilter] = {}
        self._tracks: OrderedDict[bytes, Track] = OrderedDict()

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
        SceneFilter(self._catalogue, replace(self._settings, iterations=2, sweeps=0)).estimate(scene, [suspect])

    def estimate(self, scene: ObservedScene, suspects: Sequence[Suspect]) -> SceneResult:
        """Estimates the suspects in the order given, earlier ones fixed, then visits again what has changed."""
        tracks = self._sequence(scene, suspects)
        layers = [self._layer(scene, s, t) for s, t in zip(suspects, tracks, strict=True)]
        self._rescue(scene, suspects, tracks, layers)
        stale = {
            i
            for i, found in enumerate(self._found(scene, tracks, layers))
            if found.cost > self._settings.poor or self._seen_by(scene, suspects[i], layers[i + 1 :])
        }
        for sweep in range(self._settings.sweeps):
            stale = self._sweep(scene, suspects, tracks, layers, stale=stale, number=sweep)
        return self._weigh(scene, tracks, layers)

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

    def _remembered(
        self, key: bytes, scene: ObservedScene, background: Float32s, suspect: Suspect, iterations: int
    ) -> Track:
        if key not in self._tracks:
            box = pixels(suspect.box, scene)
            self._tracks[key] = self._filter(suspect.label).run(
                scene, background, box, iterations=iterations, rng=_generator(key)
            )
            if len(self._tracks) > self._memory:
                self._tracks.popitem(last=False)
        return self._tracks[key]

    def _rescue(
        self, scene: ObservedScene, suspects: Sequence[Suspect], tracks: list[Track], layers: list[Float32s]
    ) -> None:
        """Starts the filter anew for objects that explain nothing, now that the readings of the others are explained.

        A tray that is estimated first sees the things that stand on it as readings in front of it, and may hide.
        """
        share = self._settings.iterations // max(1, len(suspects))
        key = _extended_by(self._observation_key(scene, share), b"rescue")
        cost = scene_cost(scene, layers, self._settings.cost)
        for i, suspect in enumerate(suspects if self._settings.sweeps else ()):
            key = _extended(key, suspect)
            others = layers[:i] + layers[i + 1 :]
            without = scene_cost(scene, others, self._settings.cost)
            if cost < without * (1 - _IDLE):
                continue
            box = pixels(suspect.box, scene)
            track = self._filter(suspect.label).run(
                scene, _composite(scene, others), box, iterations=share, rng=_generator(key)
            )
            layer = self._layer(scene, suspect, track)
            found = scene_cost(scene, [*others, layer], self._settings.cost)
            if found < without:
                tracks[i], layers[i], cost = track, layer, found

    def _sweep(
        self, scene: ObservedScene, suspects: Sequence[Suspect], tracks: list[Track], layers: list[Float32s], *,
        stale: set[int], number: int,
    ) -> set[int]:  # fmt: skip
        """Visits the stale objects again with all others known; returns those around which something changed."""
        key = self._observation_key(scene, number)
        changed: set[int] = set()
        for i, suspect in enumerate(suspects):
            key = _extended(key, suspect)
            if i not in stale:
                continue
            others = _composite(scene, layers[:i] + layers[i + 1 :])
            box = pixels(suspect.box, scene)
            track = self._filter(suspect.label).revisit(scene, others, box, tracks[i], rng=_generator(key))
            if track is not tracks[i]:
                tracks[i], layers[i] = track, self._layer(scene, suspect, track)
                changed |= {j for j in range(len(suspects)) if self._seen_by(scene, suspects[j], [layers[i]])}
        return changed

    def _seen_by(self, scene: ObservedScene, suspect: Suspect, layers: Sequence[Float32s]) -> bool:
        """Whether one of the layers reaches into a suspect's box."""
        x0, y0, x1, y1 = pixels(suspect.box, scene)
        return any(bool((layer[y0:y1, x0:x1] > 0).any()) for layer in layers)

    def _weigh(self, scene: ObservedScene, tracks: Sequence[Track], layers: Sequence[Float32s]) -> SceneResult:
        return SceneResult(tuple(self._found(scene, tracks, layers)), scene_cost(scene, layers, self._settings.cost))

    def _found(self, scene: ObservedScene, tracks: Sequence[Track], layers: Sequence[Float32s]) -> Iterator[Found]:
        for i, track in enumerate(tracks):
            yield _fit(scene, track, layers[i], _composite(scene, [*layers[:i], *layers[i + 1 :]]), self._settings.cost)

    def _filter(self, label: str) -> ObjectFilter:
        if label not in self._filters:
            self._filters[label] = ObjectFilter(self._catalogue[label], self._settings)
        return self._filters[label]

    def _layer(self, scene: ObservedScene, suspect: Suspect, track: Track) -> Float32s:
        return inverse_depth(self._filter(suspect.label).fine.soup, track.T_camera_object, scene.view)

    def _added(self, background: Float32s, scene: ObservedScene, suspect: Suspect, track: Track) -> Float32s:
        return with_object(background, self._filter(suspect.label).fine.soup, track.T_camera_object, scene.view)

    def _observation_key(self, scene: ObservedScene, share: int) -> bytes:
        digest = hashlib.blake2b(np.array([self._seed, share]).tobytes(), digest_size=16)
        digest.update(scene.depth.tobytes())
        digest.update(scene.T_camera_table.tobytes())
        return digest.digest()


def scene_cost(scene: ObservedScene, layers: Sequence[Float32s], form: CostForm) -> float:
    """d(R, O) of a whole scene, metres times pixels: the same pixels count whatever the hypothesis.

    ``layers`` are the objects' inverse depths, H x W. Foreground that no object explains costs what it would cost
    with the support plane alone.
    """
    cost = credits(scene, scene.plane_inverse, form)
    if not layers:
        return float(cost.sum(dtype=np.float64))
    rendered = np.maximum.reduce(list(layers))
    shown = (rendered > scene.plane_inverse) & (scene.factor > 0)
    behind = scene.factor * (1.0 / np.where(shown, rendered, 1.0) - scene.depth)
    explained = np.minimum(np.abs(behind), form.truncation)
    hidden = behind > form.occluder_margin
    cost = np.where(shown, np.where(hidden, cost + form.occluder_cost, explained), cost)
    return float(cost.sum(dtype=np.float64))


def _fit(scene: ObservedScene, track: Track, layer: Float32s, others: Float32s, form: CostForm) -> Found:
    silhouette = layer > 0
    behind = scene.factor * (1.0 / np.where(silhouette, layer, 1.0) - scene.depth)
    hidden = (layer < others) | (behind > form.occluder_margin)
    shown = silhouette & ~hidden
    read = shown & (scene.factor > 0)
    distances = np.minimum(np.abs(behind[read]), form.truncation)
    cost = float(distances.mean(dtype=np.float64)) if read.any() else form.truncation
    return Found(track, cost, float(shown.sum() / max(1, silhouette.sum())))


def _composite(scene: ObservedScene, layers: Sequence[Float32s]) -> Float32s:
    return np.maximum.reduce([scene.plane_inverse, *layers])


def _extended(key: bytes, suspect: Suspect) -> bytes:
    return _extended_by(key, suspect.label.encode() + suspect.box.tobytes())


def _extended_by(key: bytes, data: bytes) -> bytes:
    return hashlib.blake2b(key + data, digest_size=16).digest()


def _generator(key: bytes) -> np.random.Generator:
    return np.random.default_rng(int.from_bytes(key, "little"))
