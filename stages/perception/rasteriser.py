"""Renders one mesh to depth on one core: the Numba kernel that every particle passes through.

Triangles lie in memory as blocks of 16 lanes (array of structures of arrays), so that the set-up of a
block compiles to vector instructions. The z-buffer holds inverse depth, which is linear on the screen, so
that the depth test is a maximum and an empty pixel is zero. Back faces are culled. Pixel centres have
integer coordinates and edges are inclusive.
"""

# ruff: noqa: PLR0917, PLW3301
# pyright: reportMissingParameterType=false
# Kernels take plain arrays by position, and only nested minima of two values compile to vector instructions.

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy import ceil, floor
from numpy.typing import NDArray

from stages.perception.pixel_math import INLINED, KERNEL, NEAR, screen_matrix, triangle_setup
from stages.scene.catalogue import Floats, Mesh

Float32s = NDArray[np.float32]

LANES = 16
SETUP_ROWS = 13
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

    def rays(self) -> Floats:
        """H x W x 3: directions through the pixel centres with unit depth."""
        x = (np.arange(self.width, dtype=np.float64) - self.cx) / self.fx
        y = (np.arange(self.height, dtype=np.float64) - self.cy) / self.fy
        columns, rows = np.meshgrid(x, y)
        return np.stack([columns, rows, np.ones((self.height, self.width))], -1)

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

    def scratch(self) -> Float32s:
        """Working memory for the set-up of every triangle."""
        return np.zeros(self.blocks * SETUP_ROWS * LANES, np.float32)


def inverse_depth(soup: Soup, T_camera_object: Floats, view: View) -> Float32s:
    """H x W image of 1/z of one object in metres, 0 where it is not; zeros where it reaches the camera."""
    z_buffer = np.zeros(view.height * view.width, np.float32)
    render_inverse(soup.lanes, soup.blocks, soup.corners, kernel_pose(T_camera_object), view.numbers, z_buffer,
                   soup.scratch())  # fmt: skip
    return z_buffer.reshape(view.height, view.width)


def kernel_pose(T_camera_object: Floats) -> Float32s:
    """The 3 x 4 rows the kernels read."""
    return np.ascontiguousarray(T_camera_object[:3], np.float32)


@numba.njit(**KERNEL)
def render_inverse(lanes, blocks, corners, pose, view, z_buffer, scratch):
    """Fills a zeroed z-buffer of the whole view; returns False where the object reaches the camera."""
    m = screen_matrix(pose, view)
    x0, y0, x1, y1 = screen_bounds(corners, m, view)
    if x1 < x0 or y1 < y0:
        return x0 <= view[4]
    set_up(lanes, blocks, m, _f(0), view[4] - _f(1), _f(0), view[5] - _f(1), scratch)
    fill(scratch, blocks, z_buffer, int(view[4]))
    return True


@numba.njit(**INLINED)
def screen_bounds(corners, m, view):
    """Pixels x0, y0, x1, y1 (inclusive) the enclosing box may touch; x1 < x0 where none, x0 beyond the view where
    a corner is too near."""
    u0 = v0 = _f(1e9)
    u1 = v1 = _f(-1e9)
    near = _f(1e9)
    for i in range(8):
        x, y, z = corners[i, 0], corners[i, 1], corners[i, 2]
        depth = m[8] * x + m[9] * y + m[10] * z + m[11]
        u = (m[0] * x + m[1] * y + m[2] * z + m[3]) / depth
        v = (m[4] * x + m[5] * y + m[6] * z + m[7]) / depth
        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        near = min(near, depth)
    if near < _f(NEAR):
        return view[4] + _f(1), _f(0), _f(0), _f(0)
    return (max(_f(0), ceil(u0)), max(_f(0), ceil(v0)),
            min(view[4] - _f(1), floor(u1)), min(view[5] - _f(1), floor(v1)))  # fmt: skip


@numba.njit(**INLINED)
def set_up(S, blocks, m, left, right, top, bottom, T):
    """Stores what ``triangle_setup`` says of every triangle, lane by lane."""
    for b in range(_u(blocks)):
        s = b * _u(9 * LANES)
        o = b * _u(SETUP_ROWS * LANES)
        for lane in range(_u(LANES)):
            i = s + lane
            k = o + lane
            (T[k], T[k + _u(16)], T[k + _u(32)], T[k + _u(48)], T[k + _u(64)], T[k + _u(80)], T[k + _u(96)],
             T[k + _u(112)], T[k + _u(128)], T[k + _u(144)], T[k + _u(160)], T[k + _u(176)],
             T[k + _u(192)]) = triangle_setup(
                S[i], S[i + _u(16)], S[i + _u(32)], S[i + _u(48)], S[i + _u(64)], S[i + _u(80)], S[i + _u(96)],
                S[i + _u(112)], S[i + _u(128)], m, left, right, top, bottom,
            )  # fmt: skip


@numba.njit(**INLINED)
def fill(T, blocks, Z, row_length):
    """Writes the greatest inverse depth of the triangles that cover each pixel."""
    one = _f(1)
    zero = _f(0)
    for b in range(_u(blocks)):
        for lane in range(_u(LANES)):
            k = b * _u(SETUP_ROWS * LANES) + lane
            if not (T[k] > zero and T[k + _u(16)] > zero):
                continue
            width = np.int32(T[k])
            row = np.int32(T[k + _u(48)]) * np.int32(row_length) + np.int32(T[k + _u(32)])
            wb, wd, wz = T[k + _u(64)], T[k + _u(80)], T[k + _u(96)]
            bx, by, dx, dy = T[k + _u(112)], T[k + _u(128)], T[k + _u(144)], T[k + _u(160)]
            zx, zy = T[k + _u(176)], T[k + _u(192)]
            for _ in range(np.int32(T[k + _u(16)])):
                eb, ed, ez = wb, wd, wz
                for i in range(_u(row), _u(row + width)):
                    if min(min(eb, ed), one - eb - ed) >= zero and ez > Z[i]:
                        Z[i] = ez
                    eb += bx
                    ed += dx
                    ez += zx
                wb += by
                wd += dy
                wz += zy
                row += np.int32(row_length)
