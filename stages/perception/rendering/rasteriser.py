"""Renders one mesh to depth on one core: the Numba kernel that every particle passes through.

Triangles lie in memory as blocks of 16 lanes (array of structures of arrays) and pixels as tiles of 4 x 4, so
that setting up a block and filling a tile compile to a few vector instructions without a branch. The z-buffer
holds inverse depth, which is linear on the screen, so that the depth test is a maximum and an empty pixel is
zero. Back faces are culled. Pixel centres have integer coordinates and edges are inclusive.
"""

# ruff: noqa: PLR0917
# pyright: reportMissingParameterType=false
# Kernels take plain arrays by position.

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy import ceil, floor
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.perception.rendering.pixel_math import INLINED, KERNEL, NEAR, project, screen_matrix, triangle_setup
from stages.scene.catalogue import Mesh

Float32s = NDArray[np.float32]

LANES = 16
SIDE = 4
"""Pixels along a tile: LANES = SIDE * SIDE."""
SETUP_ROWS = 12
_f = np.float32
_u = np.uintp


@dataclass(frozen=True)
class View:
    """A pinhole camera in pixels of its own image; pixel centres at integer coordinates."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @staticmethod
    def of(K: Floats, width: int, height: int) -> View:
        """The view of an intrinsic matrix K, 3 x 3 pixels."""
        return View(K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height)

    def sampled(self, x0: int, y0: int, x1: int, y1: int, stride: int) -> View:
        """The view that sees every ``stride``-th pixel of rows [y0, y1) and columns [x0, x1)."""
        return View(
            self.fx / stride,
            self.fy / stride,
            (self.cx - x0) / stride,
            (self.cy - y0) / stride,
            -(-(x1 - x0) // stride),
            -(-(y1 - y0) // stride),
        )

    @property
    def numbers(self) -> Float32s:
        """fx, fy, cx, cy, width, height for the kernels."""
        return np.array([self.fx, self.fy, self.cx, self.cy, self.width, self.height], np.float32)

    @lru_cache(maxsize=4)  # noqa: B019 (of a value)
    def rays(self) -> Floats:
        """H x W x 3, read-only: directions through the pixel centres with unit depth."""
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0] = (np.arange(self.width, dtype=np.float64) - self.cx) / self.fx
        rays[..., 1] = ((np.arange(self.height, dtype=np.float64) - self.cy) / self.fy)[:, None]
        rays.flags.writeable = False
        return rays

    def project(self, points: Floats) -> Floats:
        """Pixel coordinates of points in the camera frame, ... x 3 metres -> ... x 2."""
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack([x / z * self.fx + self.cx, y / z * self.fy + self.cy], -1)


@dataclass(frozen=True)
class Soup:
    """A mesh laid out for the kernel."""

    lanes: Float32s
    """Blocks of 9 x 16 values: coordinate by coordinate of the three corners, 16 triangles at a time."""
    blocks: int
    corners: Float32s
    """8 x 3 corners of the enclosing box, metres."""

    @staticmethod
    def of(mesh: Mesh) -> Soup:
        """Lays out a mesh; degenerate triangles fill the last block and are culled."""
        blocks = -(-len(mesh.faces) // LANES)
        triangles = np.zeros((blocks * LANES, 9), np.float32)
        triangles[: len(mesh.faces)] = mesh.vertices[mesh.faces].reshape(-1, 9)
        lanes = np.ascontiguousarray(triangles.reshape(blocks, LANES, 9).transpose(0, 2, 1)).ravel()
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        select = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
        return Soup(lanes, blocks, np.where(select, high, low).astype(np.float32))


def inverse_depth(soup: Soup, T_camera_object: Floats, view: View) -> Float32s:
    """H x W image of 1/z of one object in metres, 0 where it is not; zeros where it reaches the camera."""
    image = np.zeros((view.height, view.width), np.float32)
    render_inverse(soup.lanes, soup.blocks, soup.corners, kernel_pose(T_camera_object), view.numbers, image)
    return image


def kernel_pose(T_camera_object: Floats) -> Float32s:
    """The 3 x 4 rows the kernels read."""
    return np.ascontiguousarray(T_camera_object[:3], np.float32)


@numba.njit(**KERNEL)
def render_inverse(lanes, blocks, corners, pose, view, image):
    """Draws into a zeroed image of the whole view; nothing where the object reaches the camera."""
    Z, scratch, survivors = working_memory(blocks, view)
    m = screen_matrix(pose, view)
    window, inside, _ = screen_window(corners, m, view)
    if inside:
        rasterise(lanes, blocks, m, window, scratch, survivors, Z)
        untile(Z, window, image[SIDE * window[1] :, SIDE * window[0] :])


@numba.njit(**INLINED)
def working_memory(blocks, view):
    """A zeroed z-buffer of tiles, room for the set-up of every triangle and for the list of those that survive it."""
    return (np.zeros(tiles_of(view) * LANES, np.float32), np.zeros(blocks * SETUP_ROWS * LANES, np.float32),
            np.zeros(blocks * LANES + 1, np.int32))  # fmt: skip


@numba.njit(**INLINED)
def tiles_of(view):
    """How many tiles the view has, those that hang over its edges included."""
    return ((int(view[4]) + SIDE - 1) // SIDE) * ((int(view[5]) + SIDE - 1) // SIDE)


@numba.njit(**INLINED)
def screen_bounds(corners, m, view):
    """Pixels x0, y0, x1, y1 (inclusive) the enclosing box may touch; x1 < x0 where none, x0 beyond the view where
    a corner is too near."""
    u0 = v0 = _f(1e9)
    u1 = v1 = _f(-1e9)
    nearest = _f(1.0 / NEAR)
    clear = True
    for i in range(8):
        u, v, q = project(corners[i, 0], corners[i, 1], corners[i, 2], m)
        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        clear = clear and _f(0) < q <= nearest
    if not clear:
        return view[4] + _f(1), _f(0), _f(0), _f(0)
    # What lies to the right of the view must not be taken for what is too near.
    return (min(view[4], max(_f(0), ceil(u0))), max(_f(0), ceil(v0)),
            min(view[4] - _f(1), floor(u1)), min(view[5] - _f(1), floor(v1)))  # fmt: skip


@numba.njit(**INLINED)
def screen_window(corners, m, view):
    """What the enclosing box may touch, in tiles: first column, first row, columns, rows; then the last pixel column
    and row. Also whether that is anything, and whether a corner is too near."""
    x0, y0, x1, y1 = screen_bounds(corners, m, view)
    if x1 < x0 or y1 < y0:
        return (0, 0, 0, 0, x1, y1), False, x0 > view[4]
    left, top = int(x0) // SIDE, int(y0) // SIDE
    return (left, top, int(x1) // SIDE - left + 1, int(y1) // SIDE - top + 1, x1, y1), True, False


@numba.njit(**INLINED)
def rasterise(lanes, blocks, m, window, scratch, survivors, Z):
    """Writes the greatest inverse depth of the triangles that cover each pixel into the window's zeroed tiles."""
    set_up(lanes, blocks, m, window, scratch)
    fill(scratch, survivors, _survivors(scratch, blocks, survivors), window[2], Z)


@numba.njit(**INLINED)
def set_up(S, blocks, m, window, T):
    """Stores of every triangle: its first tile, how many tiles across and down (0 culls), and ``triangle_setup``'s
    weights and inverse depth at that tile's first pixel with their steps."""
    left, top, across, right, bottom = _f(SIDE * window[0]), _f(SIDE * window[1]), _f(window[2]), window[4], window[5]
    side, zero, one = _f(SIDE), _f(0), _f(1)
    part = one / side
    for b in range(_u(blocks)):
        s = b * _u(9 * LANES)
        o = b * _u(SETUP_ROWS * LANES)
        for lane in range(_u(LANES)):
            i = s + lane
            k = o + lane
            width, height, x, y, wb, wd, q, bx, by, dx, dy, qx, qy = triangle_setup(
                S[i], S[i + _u(16)], S[i + _u(32)], S[i + _u(48)], S[i + _u(64)], S[i + _u(80)], S[i + _u(96)],
                S[i + _u(112)], S[i + _u(128)], m, left, right, top, bottom,
            )  # fmt: skip
            column, row = floor(x * part), floor(y * part)
            back_x, back_y = side * column - x, side * row - y
            T[k] = row * across + column
            T[k + _u(16)] = floor((x + width - one) * part) - column + one
            rows = floor((y + height - one) * part) - row + one
            T[k + _u(32)] = rows if (width > zero) & (height > zero) else zero
            T[k + _u(48)] = wb + back_x * bx + back_y * by
            T[k + _u(64)] = wd + back_x * dx + back_y * dy
            T[k + _u(80)] = q + back_x * qx + back_y * qy
            T[k + _u(96)], T[k + _u(112)], T[k + _u(128)] = bx, dx, qx
            T[k + _u(144)], T[k + _u(160)], T[k + _u(176)] = by, dy, qy


@numba.njit(**INLINED)
def _survivors(T, blocks, survivors):
    """Lists where the triangles that may cover a pixel are stored and returns how many there are, without a branch:
    which triangles face the camera is a coin toss that no processor predicts."""
    n = 0
    for b in range(_u(blocks)):
        k = b * _u(SETUP_ROWS * LANES)
        for lane in range(_u(LANES)):
            survivors[n] = k + lane
            n += 1 if T[k + lane + _u(32)] > _f(0) else 0
    return n


@numba.njit(**INLINED)
def fill(T, survivors, n, across, Z):
    """Visits the tiles under each listed triangle."""
    side = _f(SIDE)
    pitch = _u(across * LANES)
    for j in range(n):
        k = _u(survivors[j])
        row = _u(np.int32(T[k])) * _u(LANES)
        length = _u(np.int32(T[k + _u(16)])) * _u(LANES)
        end = row + _u(np.int32(T[k + _u(32)])) * pitch
        wb, wd, q = T[k + _u(48)], T[k + _u(64)], T[k + _u(80)]
        bx, dx, qx = T[k + _u(96)], T[k + _u(112)], T[k + _u(128)]
        by, dy, qy = T[k + _u(144)], T[k + _u(160)], T[k + _u(176)]
        while row < end:
            i, row_end = row, row + length
            eb, ed, eq = wb, wd, q
            while i < row_end:
                _fill_tile(Z, i, eb, ed, eq, bx, dx, qx, by, dy, qy)
                eb, ed, eq = eb + side * bx, ed + side * dx, eq + side * qx
                i += _u(LANES)
            wb, wd, q = wb + side * by, wd + side * dy, q + side * qy
            row += pitch


@numba.njit(**INLINED)
def _fill_tile(Z, first, wb, wd, q, bx, dx, qx, by, dy, qy):
    """The depth test of one triangle at the 16 pixels of a tile."""
    zero, one = _f(0), _f(1)
    for lane in range(_u(LANES)):
        x, y = _f(np.int32(lane) & np.int32(SIDE - 1)), _f(np.int32(lane) >> np.int32(2))
        b, d = wb + (x * bx + y * by), wd + (x * dx + y * dy)
        inside = min(b, d) >= zero and b + d <= one
        inverse = q + (x * qx + y * qy) if inside else zero
        seen = Z[first + lane]
        Z[first + lane] = seen if seen > inverse else inverse


@numba.njit(**INLINED)
def untile(Z, window, image):
    """Copies the tiles of a window to rows and columns, as far as the image reaches, and zeroes them."""
    across, down = window[2], window[3]
    for y in range(min(SIDE * down, image.shape[0])):
        for x in range(min(SIDE * across, image.shape[1])):
            image[y, x] = Z[((y // SIDE) * across + x // SIDE) * LANES + (y % SIDE) * SIDE + x % SIDE]
    Z[: across * down * LANES] = _f(0)


@numba.njit(**INLINED)
def tiled(image, view, tiles):
    """Lays an H x W image, flat, out in tiles; what hangs over its edges stays as it was."""
    width, height = int(view[4]), int(view[5])
    across = (width + SIDE - 1) // SIDE
    for y in range(_u(height)):
        row = (y // _u(SIDE)) * _u(across * LANES) + (y % _u(SIDE)) * _u(SIDE)
        for column in range(_u(width // SIDE)):
            for x in range(_u(SIDE)):
                tiles[row + column * _u(LANES) + x] = image[y * _u(width) + column * _u(SIDE) + x]
        for x in range(_u(width // SIDE * SIDE), _u(width)):
            tiles[row + _u((across - 1) * LANES) + x % _u(SIDE)] = image[y * _u(width) + x]
