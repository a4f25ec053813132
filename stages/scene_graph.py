"""Scene estimate in, scene graph out: relations between the objects and regions for what stands side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from runner.contract import Refused, Stage
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import SceneEstimate, SceneGraph
from stages.messages.scene import ObjectPose, SceneObject
from stages.scene import relations, virtual
from stages.scene.catalogue import Catalogue
from stages.scene.doubts import SURE, doubts, is_below
from stages.scene.relations import Tolerances
from stages.scene.stance import Stances, Standing


class SceneGraphBuilder(Stage):
    """Asserts exist, clear, on, in and has of every estimated scene, without the objects that the image contradicts."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """What counts as touching and as beside."""

        catalogue: Path
        gap: float = 0.06
        """Objects on the same support with less than this between their footprints are side by side, metres."""
        radius: float = virtual.RADIUS
        """Radius of the region in which an object counts as still beside the other, metres."""
        tolerances: Tolerances = field(default_factory=Tolerances)
        doubts: bool = False
        """Whether somebody is there to be asked what a look leaves open."""

        def __post_init__(self) -> None:
            """Refuses distances that are not positive."""
            for name in ("gap", "radius"):
                if not getattr(self, name) > 0:
                    raise Refused(f"scene_graph.{name}={getattr(self, name)}: must be a positive number of metres")

    def __init__(self, config: Config) -> None:
        self._config = config
        self._catalogue = Catalogue.shared(config.catalogue)
        self._stances = {label: Stances(item) for label, item in self._catalogue.objects.items()}

    def on_scene_estimate(self, scene_estimate: SceneEstimate) -> SceneGraph:
        """The scene graph of an estimate; objects the catalogue does not hold are refused."""
        found = [item for item in scene_estimate.objects if not item.contradicted]
        T_table_camera = inverse(scene_estimate.T_camera_table)
        standing = [
            Standing.at(item.name, self._stances_of(item.label), T_table_camera @ item.T_camera_object)
            for item in found
        ]
        supports = relations.supports(standing, self._config.tolerances)
        regions = virtual.virtual_objects(
            standing,
            supports,
            gap=self._config.gap,
            radius=self._config.radius,
            doubtful={item.name for item in found if is_below(item, SURE)},
        )
        T_base_camera = scene_estimate.T_base_camera if scene_estimate.T_base_camera is not None else T_table_camera
        return SceneGraph(
            objects=self._objects(found, T_base_camera),
            virtual_objects=regions,
            assertions=(*relations.assertions(supports), *virtual.assertions(regions)),
            T_base_table=T_base_camera @ scene_estimate.T_camera_table,
            T_base_camera=scene_estimate.T_base_camera,
            K=scene_estimate.K,
            name=scene_estimate.name,
            scene_id=scene_estimate.scene_id,
            image_id=scene_estimate.image_id,
            support=scene_estimate.support,
            doubts=doubts(scene_estimate, self._catalogue) if self._config.doubts else (),
            unknown=scene_estimate.unknown,
            contested=scene_estimate.contested,
            unusable=scene_estimate.unusable,
        )

    def _stances_of(self, label: str) -> Stances:
        if label not in self._stances:
            known = ", ".join(sorted(self._stances))
            raise Refused(f"scene_graph: object {label!r} is not in {self._config.catalogue}; known: {known}")
        return self._stances[label]

    def _objects(self, found: Sequence[ObjectPose], T_base_camera: Floats) -> tuple[SceneObject, ...]:
        return tuple(
            SceneObject(
                name=item.name,
                label=item.label,
                T_base_object=T_base_camera @ item.T_camera_object,
                facing=1.0 if len(self._catalogue[item.label].symmetries.transforms()) == 1 else item.facing,
                visible=item.visible,
                probability=item.probability,
            )
            for item in found
        )
