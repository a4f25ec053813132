"""Hand-made scenes of catalogue objects for tests: exact poses, laid out like a person would."""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stages.geometry.arrays import Floats
from stages.geometry.regions import moved
from stages.messages import SceneEstimate, SceneGraph
from stages.messages.scene import ObjectPose
from stages.scene.catalogue import Catalogue
from stages.scene.stance import Stances, Standing, yawed
from stages.scene_graph import SceneGraphBuilder

CATALOGUE = Path(__file__).parents[2] / "stages" / "scene" / "catalogue.yaml"
T_BASE_TABLE = yawed(0.0, np.array([0.6, 0.0, 0.7]))
T_BASE_CAMERA = np.block(
    [
        [np.array([[0.0, -0.7071, 0.7071], [-1.0, 0.0, 0.0], [0.0, -0.7071, -0.7071]]), np.array([[0.1, 0.0, 1.2]]).T],
        [np.eye(4)[3:]],
    ]
)
T_BASE_CAMERA[:3, :3] = Rotation.from_matrix(T_BASE_CAMERA[:3, :3]).as_matrix()


@cache
def catalogue() -> Catalogue:
    return Catalogue.load(CATALOGUE)


@cache
def stances(label: str) -> Stances:
    return Stances(catalogue()[label])


@cache
def builder() -> SceneGraphBuilder:
    return SceneGraphBuilder(SceneGraphBuilder.Config(catalogue=CATALOGUE))


@dataclass
class Layout:
    """Objects placed one after the other, in the table frame."""

    poses: dict[str, Floats] = field(default_factory=dict[str, Floats])

    def put(self, name: str, x: float, y: float, *, yaw: float = 0.0, on: str = "", resting: int = 0) -> "Layout":
        """Places an object at (x, y) of the table, or of the object it is on or in."""
        stance, _ = stances(label_of(name)).of(catalogue()[label_of(name)].resting[resting])
        T_table_parent = yawed(0.0, np.zeros(3))
        z = 0.0
        if on:
            standing = Standing.at(on, stances(label_of(on)), self.poses[on])
            T_table_parent, carrier = standing.T_table_stance, standing.stance
            region = moved(stance.bottom, yawed(yaw, np.array([x, y, 0.0])))
            z = carrier.cavity.height(region) if carrier.cavity else carrier.high
        T = yawed(yaw, np.array([x, y, z - stance.low]))
        T[:3, :3] = T[:3, :3] @ stance.R_stance_object
        self.poses[name] = T_table_parent @ T
        return self

    def disturbed(self, rng: np.random.Generator, *, metres: float, degrees: float) -> "Layout":
        """The same objects with an error of up to ``metres`` along each axis and ``degrees`` about a random one."""
        return Layout({name: _disturbed(T, rng, metres, degrees) for name, T in self.poses.items()})

    def moved(self, T: Floats) -> "Layout":
        """Everything moved by one rigid transform of the table frame."""
        return Layout({name: T @ pose for name, pose in self.poses.items()})

    def estimate(self) -> SceneEstimate:
        """What perception would say of it."""
        T_camera_table = np.linalg.inv(T_BASE_CAMERA) @ T_BASE_TABLE
        objects = tuple(
            ObjectPose(
                name=name,
                label=label_of(name),
                T_camera_object=T_camera_table @ T,
                confidence=0.9,
                cost=0.1,
                box=np.array([0.0, 0.0, 10.0, 10.0]),
                facing=1.0,
            )
            for name, T in self.poses.items()
        )
        return SceneEstimate(
            objects=objects,
            winner=0,
            log_weights=np.zeros(1),
            left_out=0,
            T_camera_table=T_camera_table,
            T_base_camera=T_BASE_CAMERA,
            K=np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]]),
        )

    def graph(self) -> SceneGraph:
        """Its scene graph."""
        return builder().on_scene_estimate(self.estimate())


def _disturbed(T: Floats, rng: np.random.Generator, metres: float, degrees: float) -> Floats:
    axis = rng.normal(size=3)
    turn = np.deg2rad(degrees) * rng.uniform(-1, 1) * axis / np.linalg.norm(axis)
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ T[:3, :3]
    result[:3, 3] += rng.uniform(-metres, metres, 3)
    return result


def label_of(name: str) -> str:
    """``soup_can_2`` is a soup_can."""
    head, _, tail = name.rpartition("_")
    return head if tail.isdigit() else name


def asserted(graph: SceneGraph) -> set[str]:
    """Assertions as text."""
    return {str(item) for item in graph.assertions}


def carried(graph: SceneGraph) -> set[str]:
    """The on and in assertions of real objects, as text."""
    names = {item.name for item in graph.objects}
    return {str(a) for a in graph.assertions if a.predicate in ("on", "in") and a.arguments[0] in names}


def breakfast() -> Layout:
    """A tray with a cup in a bowl, a stack of two and a bottle beside it; a can on the table."""
    return (
        Layout()
        .put("tray", 0.12, 0.0, yaw=np.pi / 2)
        .put("bowl", 0.1, 0.02, on="tray")
        .put("cup", 0.0, 0.0, on="bowl")
        .put("tea_box", -0.08, 0.0, on="tray", yaw=0.3)
        .put("tuna_can", 0.0, 0.0, on="tea_box")
        .put("soup_can", -0.05, 0.3)
    )
