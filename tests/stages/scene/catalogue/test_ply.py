"""Our own reading of plain PLY files, against a mesh library's; what is not plain is left to that library."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.exchange.ply import export_ply

from stages.scene.catalogue.household_meshes import FOLDER
from stages.scene.catalogue.loading import read_mesh
from stages.scene.catalogue.ply import read_plain_ply

MUG = FOLDER / "mug.ply"
HEADER = b"""ply
format binary_little_endian 1.0
element vertex 3
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
"""
VERTICES = b"".join(np.float32(corner).tobytes() + b"\x01\x02\x03" for corner in ([0, 0, 0], [1, 0, 0], [0, 1, 0]))


def triangle(*corners: int) -> bytes:
    return bytes([len(corners)]) + np.array(corners, "<i4").tobytes()


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ply")), ids=lambda path: path.stem)
def test_the_catalogues_meshes_are_read_as_trimesh_reads_them(path: Path):
    expected: Any = trimesh.load(path, force="mesh", process=False)
    mesh = read_plain_ply(path, 0.5)
    assert mesh is not None
    assert mesh.vertices.tobytes() == (0.5 * expected.vertices).tobytes()
    assert mesh.faces.tobytes() == expected.faces.astype(np.int32).tobytes()
    assert mesh.colors.tobytes() == expected.visual.vertex_colors[:, :3].tobytes()


def test_a_file_is_read_in_its_unit(tmp_path: Path):
    (tmp_path / "t.ply").write_bytes(HEADER + VERTICES + triangle(0, 1, 2))
    mesh = read_plain_ply(tmp_path / "t.ply", 0.001)
    assert mesh is not None and mesh.vertices.tolist() == [[0, 0, 0], [0.001, 0, 0], [0, 0.001, 0]]
    assert (mesh.faces.tolist(), mesh.colors.tolist()) == ([[0, 1, 2]], [[1, 2, 3]] * 3)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        HEADER,
        HEADER + VERTICES + triangle(0, 1, 2)[:-1],
        HEADER + VERTICES + triangle(0, 1, 3),
        HEADER + VERTICES + triangle(0, 1, -1),
        HEADER + VERTICES + triangle(0, 1, 2, 0),
        HEADER.replace(b"little", b"big") + VERTICES + triangle(0, 1, 2),
        HEADER.replace(b"blue", b"s") + VERTICES + triangle(0, 1, 2),
        HEADER.replace(b"1.0\n", b"1.0\ncomment TextureFile a.png\n") + VERTICES + triangle(0, 1, 2),
        HEADER + VERTICES.replace(np.float32(1).tobytes(), np.float32("nan").tobytes()) + triangle(0, 1, 2),
    ],
)
def test_other_forms_are_left_to_the_library(data: bytes, tmp_path: Path):
    (tmp_path / "t.ply").write_bytes(data)
    assert read_plain_ply(tmp_path / "t.ply", 1.0) is None


def test_other_forms_read_the_same_through_the_library(tmp_path: Path):
    whole: Any = trimesh.load(MUG, force="mesh", process=False)
    (tmp_path / "mug.ply").write_bytes(export_ply(whole, encoding="ascii"))
    assert read_plain_ply(tmp_path / "mug.ply", 1.0) is None
    ours, theirs = read_mesh(MUG, 1.0), read_mesh(tmp_path / "mug.ply", 1.0)
    np.testing.assert_allclose(ours.vertices, theirs.vertices, atol=1e-7)
    assert (ours.faces == theirs.faces).all() and (ours.colors == theirs.colors).all()


def test_the_catalogue_does_without_the_library():
    program = """
import sys
from pathlib import Path
from typing import Any
from stages.scene.catalogue import Catalogue
Catalogue.load(Path("stages/scene/catalogue.yaml"))
assert "trimesh" not in sys.modules"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
