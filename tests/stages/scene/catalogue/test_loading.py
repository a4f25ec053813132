"""Catalogue files: formats, units and defaults, and one clear line for every kind of mistake."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.exchange.ply import export_ply

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
    trimesh.creation.box(0.01 * np.array(BOX) / scale).export(folder / "box.ply")
    np.testing.assert_allclose(load(folder, mesh(unit=unit))["jar"].dimensions, 0.01 * np.array(BOX), rtol=1e-6)


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


NAMES = [
    (
        ["table"],
        r":2: objects\.table: 'table' and the table itself are both 'table' in goals; names differ in letters a to z",
    ),
    (["Table"], r":2: objects\.Table: 'Table' and the table itself are both 'table' in goals"),
    (["cup", "jam jar", "jam_jar"], r":6: objects\.jam_jar: 'jam_jar' and 'jam jar' are both 'jam_jar' in goals"),
    (["чашка", "ложка"], r":4: objects\.ложка: 'ложка' and 'чашка' are both 'o______' in goals"),
    ([""], r":2: objects: '' is no name of an object"),
    (["cup", "  "], r":4: objects\.  : '  ' is no name of an object"),
]


@pytest.mark.parametrize(("names", "message"), NAMES)
def test_names_that_goals_cannot_tell_apart_are_refused(folder: Path, names: list[str], message: str) -> None:
    file = folder / "catalogue.yaml"
    file.write_text("objects:\n" + "".join(f'  "{name}":\n{mesh()}' for name in names), encoding="utf-8")
    with pytest.raises(Refused, match=message):
        Catalogue.load(file)


def test_names_of_bop_models_are_checked_alike(folder: Path) -> None:
    trimesh.creation.box([60, 80, 100]).export(folder / "obj_000001.ply")
    trimesh.creation.box([60, 80, 100]).export(folder / "obj_000002.ply")
    for one, other, message in (
        ("jar", "jar", r":1: 2: 'jar' and 'jar' are both 'jar' in goals"),
        ("024_bowl", "table", r":1: 2: 'table' and the table itself are both 'table' in goals"),
    ):
        (folder / "models_info.json").write_text(f'{{"1": {{"name": "{one}"}}, "2": {{"name": "{other}"}}}}')
        with pytest.raises(Refused, match=message):
            Catalogue.load(folder)


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


def test_a_mesh_of_another_unit_is_refused(folder: Path) -> None:
    says = r"box\.ply in m is 10 m long; 0\.005 to 3 m are expected; is cm \(0\.1 m\) or mm .* or inch .* meant\?"
    with pytest.raises(Refused, match=r":3: objects\.jar\.mesh: " + says):
        load(folder, mesh(unit="m"))


def test_a_mesh_that_is_large_or_small_in_every_unit_is_refused(folder: Path) -> None:
    for scale, says in (
        (1e6, r"1e\+04 m long; 0\.005 to 3 m are expected$"),
        (1e-3, r"1e-05 m long; .*; is m \(0\.01 m\)"),
    ):
        trimesh.creation.box(np.array(BOX) * scale).export(folder / "odd.ply")
        with pytest.raises(Refused, match=says):
            load(folder, mesh("odd.ply", "mm"))


def test_a_bop_model_in_metres_is_refused(tmp_path: Path) -> None:
    (tmp_path / "models_info.json").write_text('{"3": {}}')
    trimesh.creation.box([0.1, 0.1, 0.2]).export(tmp_path / "obj_000003.ply")
    with pytest.raises(
        Refused, match=r"models_info\.json:1: 3: obj_000003\.ply in mm is 0\.0002 m long; .* is m \(0\.2 m\)"
    ):
        Catalogue.load(tmp_path)


@pytest.mark.parametrize("more", ["", "    mass: 1\n    resting: [upright]\n"])
def test_a_flat_mesh_is_refused(folder: Path, more: str) -> None:
    flat = trimesh.creation.box([9, 9, 0])
    flat.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    flat.export(folder / "flat.ply")
    with pytest.raises(Refused, match=r":3: objects\.jar\.mesh: flat\.ply is flat; an object has a volume"):
        load(folder, mesh("flat.ply") + more)


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
    texture = Image.new("RGB", (4, 4), (200, 10, 20))
    box.visual = trimesh.visual.TextureVisuals(uv=np.full((len(box.vertices), 2), 0.5), image=texture)
    box.export(folder / "painted.glb")
    assert (load(folder, mesh("painted.glb"))["jar"].mesh.colors == (200, 10, 20)).all()


PAINTED = "".join(f"v {corner}\n" for corner in ("0 0 0", "9 0 0", "0 9 0", "0 0 9")) + "vt 0 0\nusemtl paint\n"
PAINTED += "".join(f"f {a}/1 {b}/1 {c}/1\n" for a, b, c in ((1, 3, 2), (1, 2, 4), (2, 3, 4), (3, 1, 4)))


def test_a_mesh_whose_material_or_texture_is_missing_is_refused(folder: Path) -> None:
    (folder / "painted.obj").write_text("mtllib painted.mtl\n" + PAINTED)
    with pytest.raises(
        Refused, match=r":3: .*mesh\.file: .*painted\.obj: its material or texture painted\.mtl is missing"
    ):
        load(folder, mesh("painted.obj"))
    (folder / "painted.mtl").write_text("newmtl paint\nKd 0.8 0.1 0.1\nmap_Kd paint.png\n")
    with pytest.raises(Refused, match=r"painted\.obj: its material or texture paint\.png is missing"):
        load(folder, mesh("painted.obj"))
    whole = trimesh.creation.box(BOX)
    whole.visual = trimesh.visual.TextureVisuals(uv=np.full((len(whole.vertices), 2), 0.5))
    header, _, body = export_ply(whole, encoding="ascii").partition(b"element vertex")
    (folder / "painted.ply").write_bytes(header + b"comment TextureFile paint.png\nelement vertex" + body)
    with pytest.raises(Refused, match=r"painted\.ply: its material or texture paint\.png is missing"):
        load(folder, mesh("painted.ply"))


def test_a_texture_may_lie_in_another_folder_and_a_material_may_have_none(folder: Path) -> None:
    (folder / "meshes").mkdir()
    (folder / "meshes" / "painted.obj").write_text("mtllib painted.mtl\n" + PAINTED)
    for line, color in (("", (204, 26, 26)), ("map_Kd ../paint.png\n", (200, 10, 20))):
        (folder / "meshes" / "painted.mtl").write_text(f"newmtl paint\nKd 0.8 0.1 0.1\n{line}")
        Image.new("RGB", (4, 4), (200, 10, 20)).save(folder / "paint.png")
        assert (load(folder, mesh("meshes/painted.obj"))["jar"].mesh.colors == color).all()
    box = trimesh.creation.box(BOX)
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[200, 10, 20, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.full((len(box.vertices), 2), 0.5), material=material)
    box.export(folder / "painted.glb")
    assert (load(folder, mesh("painted.glb"))["jar"].mesh.colors == (200, 10, 20)).all()


@pytest.mark.parametrize("suffix", ["ply", "obj"])
@pytest.mark.parametrize("color", [None, (200, 10, 20, 255)])
def test_a_vertex_of_no_triangle_does_not_count(folder: Path, suffix: str, color: tuple[int, ...] | None) -> None:
    box = trimesh.creation.box(BOX)
    colors = None if color is None else [(0, 0, 0, 255), *[color] * len(box.vertices)]
    vertices, faces = np.vstack([[500.0, 500, 500], box.vertices]), box.faces + 1
    trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False).export(folder / f"far.{suffix}")
    jar = load(folder, mesh(f"far.{suffix}"))["jar"]
    np.testing.assert_allclose(jar.dimensions, [0.06, 0.08, 0.10], atol=1e-6)
    np.testing.assert_allclose(jar.mesh.vertices[jar.mesh.faces], 0.01 * box.triangles, atol=1e-6)
    assert color is None or (jar.mesh.colors == color[:3]).all()
