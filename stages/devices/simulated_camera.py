"""The simulated camera: renders table, room, objects and robot, and finds the robot's own pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.devices.board import print_of
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.hand_eye.board import Board
from stages.messages import Snapshot
from stages.messages.arrays import Depth, Mask, Rgb
from stages.perception.rendering.renderer import Camera, Item, Light, Lighting, Renderer
from stages.robots import Robot, Table
from stages.scene.catalogue import Catalogue, Mesh
from stages.scene.catalogue.household_meshes import block
from stages.scene.scoring import label_of

ROBOT_MARGIN = 0.03
"""Metres by which the robot's surface may lie behind a reading and still be what was read."""
_MASK_GROWTH = 1 / 64
"""Share of the image's width by which the robot may lie beside where encoders and the declared camera have it: 5 mm,
half a degree and, at 640 pixels across, 4 pixels between depth and colour."""
_ROOM_LIGHT = Lighting(
    lights=(
        Light("directional", (0.35, 0.25, -1.0), 2.0),
        Light("directional", (0.60, -0.50, -0.55), 1.1),
        Light("directional", (-0.40, 0.20, -0.70), 0.5),
    ),
    ambient=(0.36, 0.36, 0.38),
)
_SKY = (214, 218, 222)


class SimulatedCamera:
    """Renders snapshots of the simulated world. One per process: it owns an OpenGL context."""

    def __init__(self, catalogue: Catalogue, robot: Robot, board: Board | None = None) -> None:
        """``board``: how the one looks that a snapshot may have."""
        self._catalogue, self._robot, self._K = catalogue, robot, robot.camera.K
        self._board = board
        self._renderer = Renderer(*robot.camera.size)

    def warm_up(self) -> None:
        """Draws room and robot once: their meshes take a second to lay out, which the first look does not wait for."""
        posture = self._robot.posture
        links = self._links(tuple(posture), np.array(list(posture.values())))
        items = [*room(self._robot.table, self._robot.floor), *links]
        camera = Camera(self._K, inverse(self._robot.T_camera_base))
        self._renderer.color(items, camera, lighting=_ROOM_LIGHT)
        self._renderer.depth(items, camera)

    def image(self, snapshot: Snapshot, T_base_camera: Floats) -> tuple[Rgb, Depth]:
        """The lit colour image (H x W x 3) and the depth image without noise (H x W, metres).

        They are those of a camera at ``T_base_camera`` as far as the snapshot's sensors are right.
        """
        errors = snapshot.errors
        if errors is None:
            items = self._items(snapshot, snapshot.joint_positions)
            camera = Camera(self._K, T_base_camera)
            return self._color(items, camera), self._depth(items, camera)
        positions = snapshot.joint_positions + errors.joints
        items = self._items(snapshot, positions)
        T_base_color = self._robot.camera_pose(snapshot.joint_names, positions) @ errors.T_believed_true
        rgb = self._color(items, Camera(self._K, T_base_color))
        depth = self._depth(items, Camera(self._K, T_base_color @ errors.T_color_depth))
        return np.clip(np.round(rgb * errors.gains), 0, 255).astype(np.uint8), depth * np.float32(errors.depth)

    def robot_mask(self, snapshot: Snapshot, T_base_camera: Floats, depth: Depth) -> Mask:
        """Where the robot is in the image, H x W, from its encoders and the observed ``depth`` alone.

        Pixels that the robot's rendered surface covers, unless the reading lies clearly in front of it; grown by as
        much as an uncalibrated camera is off.
        """
        items = self._links(snapshot.joint_names, snapshot.joint_positions)
        body = self._depth(items, Camera(self._K, T_base_camera))
        return robot_pixels(body, depth)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()

    def _color(self, items: Sequence[Item], camera: Camera) -> Rgb:
        shown = self._in_sight(items, camera)
        return self._renderer.color(shown, camera, lighting=_ROOM_LIGHT, background=_SKY)

    def _depth(self, items: Sequence[Item], camera: Camera) -> Depth:
        return self._renderer.depth(self._in_sight(items, camera), camera)

    def _in_sight(self, items: Sequence[Item], camera: Camera) -> list[Item]:
        """Without what lies beside the image: a robot's meshes are large, and at home most are not seen."""
        return [item for item in items if _may_be_seen(item, camera, self._robot.camera.size)]

    def _items(self, snapshot: Snapshot, joint_positions: Floats) -> list[Item]:
        poses = zip(snapshot.names, snapshot.T_base_objects, strict=True)
        objects = (Item(self._catalogue[label_of(name, self._catalogue)].mesh, T) for name, T in poses)
        table = _table(snapshot) or self._robot.table
        links = self._links(snapshot.joint_names, joint_positions)
        return [*room(table, self._robot.floor), *objects, *links, *self._shown_board(snapshot)]

    def _shown_board(self, snapshot: Snapshot) -> list[Item]:
        if self._board is None or snapshot.T_base_board is None:
            return []
        return [Item(print_of(self._board), snapshot.T_base_board)]

    def _links(self, joint_names: Sequence[str], positions: Floats) -> list[Item]:
        return [Item(mesh, T) for mesh, T in self._robot.links(joint_names, positions)]


def _may_be_seen(item: Item, camera: Camera, size: tuple[int, int]) -> bool:
    """False where the item's enclosing box lies wholly behind the camera or beyond one edge of the image."""
    bounds = np.stack([item.mesh.vertices.min(0), item.mesh.vertices.max(0)])
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2], 1.0] for i, j, k in np.ndindex(2, 2, 2)])
    u, v, z = camera.K @ (inverse(camera.T_world_camera) @ item.T_world_item @ corners.T)[:3]
    width, height = size
    beyond = (z < 0, u < -z, u > (width + 1) * z, v < -z, v > (height + 1) * z)
    return not any(each.all() for each in beyond)


def robot_pixels(body: Depth, depth: Depth) -> Mask:
    """Where the rendered robot ``body`` (H x W, 0 = not there) explains the observed ``depth`` (H x W)."""
    covered = (body > 0) & ((depth == 0) | (body < depth + ROBOT_MARGIN))
    growth = max(1, round(_MASK_GROWTH * depth.shape[1]))
    kernel = np.ones((2 * growth + 1, 2 * growth + 1), np.uint8)
    return cv2.dilate(covered.astype(np.uint8), kernel).astype(bool)


def _table(snapshot: Snapshot) -> Table | None:
    """The table of the snapshot; None where it names none."""
    if snapshot.T_base_table is None or snapshot.table_size is None:
        return None
    x, y, height = snapshot.T_base_table[:3, 3].tolist()
    depth, width = snapshot.table_size.tolist()
    return Table(center=(x, y), size=(depth, width), height=height)


@lru_cache(maxsize=1)
def room(table: Table, ground: float) -> tuple[Item, ...]:
    """Table, floor (at height ``ground``) and walls, in the robot's base frame."""
    x, y = table.center
    depth, width = table.size
    top = _painted((depth, width, table.thickness), 0.012, _planks)
    leg = _painted((0.05, 0.05, table.height - table.thickness - ground), 0.2, _plain((92, 84, 78)))
    leg_height = (table.height - table.thickness + ground) / 2
    corners = [(sx * (depth / 2 - 0.05), sy * (width / 2 - 0.05)) for sx in (-1, 1) for sy in (-1, 1)]
    floor = _painted((6.0, 6.0, 0.02), 0.05, _tiles)
    wall = _painted((0.02, 6.0, 2.6), 0.1, _plain((206, 204, 196)))
    side = _painted((6.0, 0.02, 2.6), 0.1, _plain((196, 202, 206)))
    return (
        _at(top, x, y, table.height - table.thickness / 2),
        *(_at(leg, x + dx, y + dy, leg_height) for dx, dy in corners),
        _at(floor, 1.0, 0.0, ground - 0.01),
        _at(wall, 2.6, 0.0, ground + 1.3),
        *(_at(side, 1.0, sign * 2.4, ground + 1.3) for sign in (-1, 1)),
    )


Paint = Callable[[Floats], NDArray[np.uint8]]


def _painted(size: tuple[float, float, float], step: float, paint: Paint) -> Mesh:
    """A box of full extents ``size`` whose vertices, ``step`` metres apart, are coloured by ``paint``."""
    shape = block(size, step=step)
    return Mesh(shape.vertices, shape.faces.astype(np.int32), paint(shape.vertices))


def _plain(color: tuple[int, int, int]) -> Paint:
    return lambda vertices: np.tile(np.array(color, np.uint8), (len(vertices), 1))


def _planks(vertices: Floats) -> NDArray[np.uint8]:
    """Pale wood with a grain along y and slightly different planks."""
    x, y = vertices[:, 0], vertices[:, 1]
    plank = np.floor(x / 0.14)
    shade = 1 + 0.04 * np.sin(7.3 * plank) + 0.02 * np.sin(260 * x + 3 * np.sin(6 * y + plank))
    return (np.array([203, 190, 170]) * shade[:, None]).clip(0, 255).astype(np.uint8)


def _tiles(vertices: Floats) -> NDArray[np.uint8]:
    """Grey floor tiles of half a metre."""
    dark = (np.floor(vertices[:, 0] / 0.5) + np.floor(vertices[:, 1] / 0.5)) % 2 == 0
    return np.where(dark[:, None], (136, 138, 142), (158, 160, 162)).astype(np.uint8)


def _at(mesh: Mesh, x: float, y: float, z: float) -> Item:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return Item(mesh, T)
