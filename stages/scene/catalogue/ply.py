"""Reads the plain form of PLY that catalogues come in, without the 0.4 s that a mesh library takes to load.

Binary, little endian, vertices with colours, then triangles; nothing else. What is not of that form is left to others.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.scene.catalogue.objects import Mesh

_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
_HEADER = re.compile(
    rb"ply\nformat binary_little_endian 1.0\n(?:comment (?!TextureFile)[^\n]*\n)*element vertex (\d+)\n"
    rb"((?:property \w+ \w+\n)+)element face (\d+)\nproperty list (?:uchar|uint8) (?:int|int32) vertex_ind(?:ices|ex)\n"
    rb"end_header\n"
)
_FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])
_NEEDED = {"x", "y", "z", "red", "green", "blue"}
_UNDERSTOOD = _NEEDED | {"alpha", "nx", "ny", "nz"}


def read_plain_ply(path: Path, scale: float) -> Mesh | None:
    """The mesh, its lengths times ``scale``; None where the file is of another form."""
    data = path.read_bytes()
    header = _HEADER.match(data)
    vertex = None if header is None else _vertex_type(header[2].decode())
    if header is None or vertex is None:
        return None
    count, triangles, start = int(header[1]), int(header[3]), header.end()
    if len(data) != start + count * vertex.itemsize + triangles * _FACE.itemsize:
        return None
    vertices = np.frombuffer(data, vertex, count, start)
    faces = np.frombuffer(data, _FACE, triangles, start + vertices.nbytes)
    inside = (faces["corners"] == 3).all() and (faces["vertices"] >= 0).all() and (faces["vertices"] < count).all()
    return _mesh(vertices, faces["vertices"], scale) if inside and count and triangles else None


def _vertex_type(properties: str) -> np.dtype[Any] | None:
    fields = [line.split()[1:] for line in properties.splitlines()]
    names = {name for _, name in fields}
    if not _NEEDED <= names <= _UNDERSTOOD or any(kind not in _TYPES for kind, _ in fields):
        return None
    kinds = {name: _TYPES[kind] for kind, name in fields}
    plain = all(kinds[name] == "u1" for name in ("red", "green", "blue")) and len(names) == len(fields)
    return np.dtype([(name, kinds[name]) for _, name in fields]) if plain else None


def _mesh(vertices: NDArray[Any], faces: NDArray[np.int32], scale: float) -> Mesh | None:
    points = scale * np.stack([vertices[name] for name in "xyz"], -1).astype(np.float64)
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], -1)
    return Mesh(points, np.ascontiguousarray(faces, np.int32), colors) if np.isfinite(points).all() else None
