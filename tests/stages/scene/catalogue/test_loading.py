"""Catalogue files: formats, units and defaults, and one clear line for every kind of mistake."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from runner.contract import Refused
from stages.scene.catalogue import Catalogue

BOX = (6.0, 8.0, 10.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for suffix in ("ply", "stl", "obj", "glb"):
        trimesh.creation.box(BOX).export(tmp_path / f"box.{suffix}")
    return tmp_path


def load(folder: Path, body: str) -> Catalogue:
    file = folder / "catalogue.yaml"
    file.write_text(f"objects:\n  jar:\n{body}")
    return Catalogue.load(file)


def mesh(file: str = "box.ply", unit: str = "cm") -> str:
    return f"    mesh: {{file: {file}, unit: {unit}}}\n"


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb"])
def test_any_format_loads_with_defaults(folder: Path, suffix: str) -> None:
    jar = load(folder, mesh(f"box.{suffix}"))["jar"]
    np.testing.assert_allclose(jar.dimensions, [0.06, 0.08, 0.10], atol=1e-6)
    assert (jar.label, jar.concave, jar.grasps, len(jar.resting)) == (1, False, (), 6)
    assert jar.mass == pytest.approx(300 * 0.06 * 0.08 * 0.10)
    assert jar.collision[0].size == pytest.approx((0.06, 0.08, 0.10))
    assert len(jar.symmetries.transforms()) == 1


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("inch", 0.0254)])
def test_units(folder: Path, unit: str, scale: float) -> None:
    np.testing.assert_allclose(load(folder, mesh(unit=unit))["jar"].dimensions, np.array(BOX) * scale, rtol=1e-6)


def test_shorthands_expand(folder: Path) -> None:
    body = """
    symmetries_discrete:
      - {axis: z, degrees: 180, offset: [0.1, 0, 0]}
      - [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0.2, 0, 0, 0, 1]
    resting: [x-up, [1, 0, 0, 0, 1, 0, 0, 0, 1]]
    collision:
      - {ring: {radius: [0.03, 0.04], height: 0.1, wall: 0.004, floor: 0.005, segments: 8}}
      - {cylinder: [0.01, 0.02], at: [0, 0, 0.1], axis: x, degrees: 90}
    grasps:
      - side: {height: 0.07, azimuths: [90]}
      - top: {yaws: 4, width: 0.06}
      - rim: {azimuths: [0], radius: 0.03, width: 0.005, depth: 0.02, lean: 30}
      - pose: {name: odd, kind: top, approach: [0, 0, -2], closing: [1, 0, 0.5], at: [0, 0, 0], width: 0.05}
"""
    jar = load(folder, mesh() + body)["jar"]
    np.testing.assert_allclose(jar.symmetries.discrete[0] @ [0.1, 0, 0, 1], [0.1, 0, 0, 1], atol=1e-12)
    assert jar.symmetries.discrete[1, 2, 3] == 0.2
    np.testing.assert_allclose(jar.resting[0] @ [1, 0, 0], [0, 0, 1], atol=1e-12)
    assert [piece.kind for piece in jar.collision] == ["box"] * 8 + ["cylinder"] * 2
    np.testing.assert_allclose(jar.collision[-1].T_object_primitive[:3, :3] @ [0, 0, 1], [0, -1, 0], atol=1e-12)
    names = ["side 90", "side 90 rolled", "top 0", "top 90", "top 180", "top 270", "rim 0", "odd"]
    assert [grasp.name for grasp in jar.grasps] == names
    np.testing.assert_allclose(jar.grasps[-1].T_object_grasp[:3, 1], [1, 0, 0])
    leaning = jar.grasps[-2].T_object_grasp
    np.testing.assert_allclose(leaning[:3, 0], [-0.5, 0, -np.sqrt(0.75)])
    np.testing.assert_allclose(
        leaning[:3, 3] - 0.02 * leaning[:3, 0], [0.03, 0, jar.mesh.vertices[:, 2].max()], atol=1e-9
    )
    assert jar.grasps[0].width == pytest.approx(0.06, abs=1e-6)


MISTAKES = [
    ("    mesh: {file: pot.ply, unit: cm}\n", r":3: objects.jar.mesh.file: .*pot.ply: no such mesh file"),
    ("    mesh: {file: box.ply}\n", r":3: objects.jar.mesh: the key 'unit' is missing"),
    ("    mesh: {file: box.ply, unit: feet}\n", r":3: objects.jar.mesh.unit: 'feet' is not one of m, cm, mm, inch"),
    ("    mass: 1\n", r":3: objects.jar: the key 'mesh' is missing"),
    (mesh() + "    colour: red\n", r":4: objects.jar.colour: unknown key; valid are label, mesh, concave"),
    (mesh() + "    mass: -1\n", r":4: objects.jar.mass: -1 is not a number above 0"),
    (mesh() + "    mass: heavy\n", r":4: objects.jar.mass: 'heavy' is not a number above 0"),
    (mesh() + "    concave: 3\n", r":4: objects.jar.concave: 3 is not true or false"),
    (mesh() + "    label: 1.5\n", r":4: objects.jar.label: 1.5 is not a whole number from 1"),
    (mesh() + "    mass: 1\n    mass: 2\n", r":5: objects.jar: the key 'mass' stands there twice"),
    (mesh() + "    resting: [upsidedown]\n", r":4: objects.jar.resting: 'upsidedown' is neither one of upright"),
    (mesh() + "    symmetries_discrete: [[1, 2]]\n", r":4: objects.jar.symmetries_discrete: a symmetry is 16 numbers"),
    (
        mesh() + "    symmetries_discrete: [[2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]\n",
        r":4: objects.jar.symmetries_discrete: a symmetry is a rotation and a translation",
    ),
    (mesh() + "    symmetries_continuous: [{axis: w}]\n", r":4: .*\[0\].axis: 'w' is not one of x, y, z"),
    (mesh() + "    symmetries_continuous: [{axis: [0, 0, 0]}]\n", r":4: .*axis: an axis has a length"),
    (mesh() + "    collision: [{ball: 1}]\n", r":4: objects.jar.collision\[0\].ball: unknown key; valid are box"),
    (mesh() + "    collision: [{at: [0, 0, 0]}]\n", r":4: .*collision\[0\]: exactly one of box, cylinder, ring"),
    (mesh() + "    collision: [{box: [1, 2]}]\n", r":4: .*box: \[1, 2\] is not a list of 3 numbers"),
    (mesh() + "    collision: [{cylinder: [0, 1]}]\n", r":4: .*cylinder: sizes are above zero"),
    (mesh() + "    grasps: [{below: {}}]\n", r":4: .*grasps\[0\].below: unknown key; valid are top, side, rim, pose"),
    (mesh() + "    grasps: [{top: {}}]\n", r":4: .*grasps\[0\].top: the key 'yaws' is missing"),
    (mesh() + "    grasps:\n      - rim: {azimuths: 4, radius: 0.1}\n", r":5: .*rim: the key 'width' is missing"),
    (mesh() + "    grasps: top\n", r":4: objects.jar.grasps: 'top' is not a list"),
    (mesh() + "  pot:\n" + mesh() + "    label: 1\n", r":6: objects.pot.label: 1 is the label of 'jar' already"),
    ("    mesh: [\n", r":\d+: not valid YAML"),
    (
        mesh() + "    mass: 2024-13-45\n",
        r":4: objects.jar.mass: '2024-13-45' is no value, month must be in 1..12.*; in quotes it is a text",
    ),
    (mesh() + "    mass: !kg 1\n", r":4: objects.jar.mass: '1' is no value, .*'!kg'; in quotes"),
]


@pytest.mark.parametrize(("body", "message"), MISTAKES)
def test_mistakes_are_refused_in_one_line(folder: Path, body: str, message: str) -> None:
    with pytest.raises(Refused) as refusal:
        load(folder, body)
    assert re.search(r"catalogue\.yaml" + message, str(refusal.value)), str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_missing_catalogue_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"nothing\.yaml: no such catalogue"):
        Catalogue.load(tmp_path / "nothing.yaml")


def test_folder_without_models_info_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"models_info\.json: cannot be read: No such file"):
        Catalogue.load(tmp_path)


def test_bop_folder_with_a_missing_mesh_is_refused(tmp_path: Path) -> None:
    (tmp_path / "models_info.json").write_text('{"3": {}}')
    with pytest.raises(Refused, match=r"obj_000003\.ply: no such mesh file"):
        Catalogue.load(tmp_path)


def test_a_link_that_git_wrote_as_a_file_is_followed(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / "models_info.json").write_text('{"3": {}}')
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "models").write_text("../shared\n")
    with pytest.raises(Refused, match=r"shared/obj_000003\.ply: no such mesh file"):
        Catalogue.load(tmp_path / "set" / "models")


def test_unreadable_mesh_is_refused_with_the_formats(folder: Path) -> None:
    (folder / "noise.ply").write_bytes(b"ply\nnot really")
    with pytest.raises(Refused, match=r"noise\.ply: not a readable mesh .*formats are .*stl"):
        load(folder, mesh("noise.ply"))
    (folder / "noise.xyzzy").write_bytes(b"?")
    with pytest.raises(Refused, match=r"noise\.xyzzy: not a readable mesh .*formats are"):
        load(folder, mesh("noise.xyzzy"))


def test_textured_mesh_gets_vertex_colours(folder: Path) -> None:
    box = trimesh.creation.box(BOX)
    from PIL import Image

    texture = Image.new("RGB", (4, 4), (200, 10, 20))
    box.visual = trimesh.visual.TextureVisuals(uv=np.full((len(box.vertices), 2), 0.5), image=texture)
    box.export(folder / "painted.glb")
    assert (load(folder, mesh("painted.glb"))["jar"].mesh.colors == (200, 10, 20)).all()
