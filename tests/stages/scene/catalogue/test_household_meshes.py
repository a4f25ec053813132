"""The generated meshes: closed, outward, centred, deterministic, small, and equal to the files in the repository."""

from itertools import combinations

import numpy as np
import pytest
import trimesh

from stages.scene.catalogue import Mesh
from stages.scene.catalogue.household_meshes import FOLDER, OBJECTS, block, circle, loft, save, tube
from stages.scene.catalogue.loading import read_mesh

BUILT = {build.__name__: build() for build in OBJECTS}


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("name", BUILT)
def test_surface_is_closed_and_faces_outwards(name: str) -> None:
    for part in solid(BUILT[name]).split(only_watertight=False):
        assert part.is_watertight
        assert part.is_winding_consistent
        assert part.volume > 0


@pytest.mark.parametrize("name", BUILT)
def test_mesh_is_dense_enough_for_its_pattern_and_centred(name: str) -> None:
    mesh = BUILT[name]
    assert 3000 <= len(mesh.vertices) <= 8000
    assert np.abs(mesh.vertices.min(0) + mesh.vertices.max(0)).max() < 1e-6
    assert len(np.unique(mesh.colors, axis=0)) >= 2


@pytest.mark.parametrize("name", BUILT)
def test_file_in_the_repository_is_what_the_code_builds(name: str) -> None:
    stored = read_mesh(FOLDER / f"{name}.ply", 1.0)
    # Not every processor has the same sine to the last bit.
    np.testing.assert_allclose(stored.vertices, BUILT[name].vertices, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(stored.faces, BUILT[name].faces)
    np.testing.assert_array_equal(stored.colors, BUILT[name].colors)


def test_files_stay_small() -> None:
    assert {path.stem for path in FOLDER.glob("*.ply")} == set(BUILT)
    assert sum(path.stat().st_size for path in FOLDER.glob("*.ply")) < 4 << 20


def test_saving_is_repeatable(tmp_path) -> None:
    for name in ("first", "second"):
        save(BUILT["cup"], tmp_path / f"{name}.ply")
    assert (tmp_path / "first.ply").read_bytes() == (tmp_path / "second.ply").read_bytes()


def test_no_two_objects_look_alike() -> None:
    histograms = {name: color_histogram(mesh) for name, mesh in BUILT.items()}
    for a, b in combinations(BUILT, 2):
        overlap = np.minimum(histograms[a], histograms[b]).sum()
        same_size = np.allclose(np.ptp(BUILT[a].vertices, axis=0), np.ptp(BUILT[b].vertices, axis=0), atol=0.01)
        assert overlap < 0.75 and not (same_size and overlap > 0.5), (a, b, overlap)


def color_histogram(mesh: Mesh) -> np.ndarray:
    """Share of area per coarse colour."""
    bins = (mesh.colors[mesh.faces[:, 0]] // 64).astype(int) @ np.array([16, 4, 1])
    return np.bincount(bins, weights=solid(mesh).area_faces, minlength=64) / solid(mesh).area


def test_block_has_its_size_and_volume() -> None:
    shape = block((0.1, 0.2, 0.05), step=0.01)
    assert trimesh.Trimesh(shape.vertices, shape.faces, process=False).volume == pytest.approx(0.001)


def test_loft_of_a_cylinder_has_its_volume() -> None:
    sections = [(0.0, 0.0, 0.0), (0.03, 0.03, 0.0), (0.03, 0.03, 0.1), (0.0, 0.0, 0.1)]
    shape = loft(circle(200), sections)
    volume = trimesh.Trimesh(shape.vertices, shape.faces, process=False).volume
    assert volume == pytest.approx(np.pi * 0.03**2 * 0.1, rel=1e-3)


def test_tube_has_its_volume() -> None:
    path = np.column_stack([np.zeros(9), np.zeros(9), np.linspace(0, 0.1, 9)])
    shape = tube(path, 0.01, count=100)
    volume = trimesh.Trimesh(shape.vertices, shape.faces, process=False).volume
    assert volume == pytest.approx(np.pi * 0.01**2 * 0.1, rel=2e-3)
