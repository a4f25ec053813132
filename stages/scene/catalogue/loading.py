"""Reads catalogues: our YAML format (docs/perception/catalogue.md) and the ``models`` folders of BOP data sets."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from runner.contract import Refused
from stages.scene.catalogue.mesh_shape import holds_water, resting_rotations
from stages.scene.catalogue.objects import CatalogueObject, Mesh
from stages.scene.catalogue.ply import read_plain_ply
from stages.scene.catalogue.properties import enclosing_box, read_collision, read_grasps, read_resting, read_symmetries
from stages.scene.catalogue.sections import Section, read_section
from stages.scene.domain import TABLE, symbol

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
SMALLEST, LARGEST = 0.005, 3.0
"""Metres that the longest side of an object's enclosing box has."""
FRICTION = 0.8
_GREY = (170, 170, 170)
_SPECIFIC_MASS = 300.0
"""Kilogrammes per cubic metre of the enclosing box: typical of packaged food and crockery."""
_LONGEST_PATH = 4096
_FLAT = 1e-5
"""Metres below which something has no thickness."""
_SYMMETRY_KEYS = ("symmetries_discrete", "symmetries_continuous", "near_symmetries_discrete")


def read_objects(path: Path) -> dict[str, CatalogueObject]:
    """The objects of a catalogue YAML file or of a BOP ``models`` folder, by name, in the file's order.

    Raises:
        Refused: naming file, line, object, key and valid choices.
    """
    folder = written_link(path) or path
    if folder.is_dir():
        return _read_bop(folder / "models_info.json")
    if not path.is_file():
        raise Refused(f"{path}: no such catalogue; it is a YAML file or a BOP models folder")
    return _read_yaml(path)


def written_link(path: Path) -> Path | None:
    """The folder that a file names by all that it holds: so git writes a link where it may not make one."""
    if path.suffix or not path.is_file() or path.stat().st_size > _LONGEST_PATH:
        return None
    target = path.parent / path.read_text(errors="replace").strip()
    return target if target.is_dir() else None


def read_mesh(path: Path, scale: float) -> Mesh:
    """A mesh of any format that trimesh reads; ``scale`` turns its lengths into metres. Vertices are its triangles'.

    Raises:
        Refused: the file is missing, unreadable or has no triangles, or a file that it names is missing.
    """
    if not path.is_file():
        raise Refused(f"{path}: no such mesh file")
    return _of_triangles(read_plain_ply(path, scale) or _read_any(path, scale))


def _of_triangles(mesh: Mesh) -> Mesh:
    used = np.zeros(len(mesh.vertices), np.bool_)
    used[mesh.faces] = True
    if used.all():
        return mesh
    number = (np.cumsum(used) - 1).astype(np.int32)
    return Mesh(mesh.vertices[used], number[mesh.faces], mesh.colors[used])


def _read_any(path: Path, scale: float) -> Mesh:
    # Loading it takes 0.4 s, which every stage that has a catalogue would wait for at its start.
    import trimesh

    named = _named_files(path)
    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False, resolver=named)
    except Exception as error:  # trimesh raises whatever its format readers raise
        formats = ", ".join(sorted(trimesh.available_formats()))
        raise Refused(f"{path}: not a readable mesh ({error}); formats are {formats}") from error
    if named.missing:
        raise Refused(
            f"{path}: its material or texture {', '.join(named.missing)} is missing; paths are from its folder"
        )
    vertices = scale * np.asarray(getattr(loaded, "vertices", ()), np.float64)
    faces = np.asarray(getattr(loaded, "faces", ()), np.int32)
    inside = len(faces) > 0 and faces.min() >= 0 and faces.max() < len(vertices)
    if not inside or not np.isfinite(vertices).all():
        raise Refused(f"{path}: a mesh with triangles and finite coordinates is expected")
    return Mesh(vertices=vertices, faces=faces, colors=_vertex_colors(loaded))


def _named_files(path: Path) -> Any:
    """Finds what a mesh file names, and keeps what is ``missing``: trimesh goes on without it."""
    from trimesh.resolvers import FilePathResolver

    class Files(FilePathResolver):
        missing: tuple[str, ...] = ()

        def get(self, name: str) -> Any:
            try:
                return super().get(name)
            except OSError:
                self.missing += (name.strip(),)
                raise

    return Files(str(path), allow_anywhere=True)


def _vertex_colors(loaded: Any) -> Any:
    visual = loaded.visual
    if visual.kind is None:
        colors: Any = _GREY
    elif visual.kind == "texture":
        # Without a texture None or one colour.
        colors = visual.material.to_color(visual.uv)
        colors = visual.material.main_color if colors is None else colors
    else:
        colors = visual.vertex_colors
    each = np.broadcast_to(np.asarray(colors, np.uint8)[..., :3], (len(loaded.vertices), 3))
    return np.ascontiguousarray(each)


def _refuse_unfit_names(section: Section, names: Iterable[tuple[str, str]]) -> None:
    """Names (key, name) by which people and goals, which are PDDL, could not tell objects from each other."""
    owners = {TABLE: "the table itself"}
    for key, name in names:
        if not name.strip():
            section.refuse(f"{name!r} is no name of an object", key)
        written = symbol(name)
        if written in owners:
            other = f"'{name}' and {owners[written]} are both '{written}' in goals"
            section.refuse(f"{other}; names differ in letters a to z, digits, - or _", key)
        owners[written] = f"'{name}'"


# --- YAML -------------------------------------------------------------------------------------------------------


def _read_yaml(path: Path) -> dict[str, CatalogueObject]:
    root = read_section(path)
    root.only("objects")
    listing = root.section("objects")
    _refuse_unfit_names(listing, [(name, name) for name in listing.values])
    objects = {name: _yaml_object(listing.section(name), name, index) for index, name in enumerate(listing.values, 1)}
    _refuse_equal_labels(listing, objects)
    return objects


def _yaml_object(section: Section, name: str, position: int) -> CatalogueObject:
    keys = ("label", "mesh", "concave", "mass", "friction", "resting", "collision", "grasps", *_SYMMETRY_KEYS)
    section.only(*keys)
    mesh = _yaml_mesh(section.section("mesh"))
    return CatalogueObject(
        name=name,
        label=section.integer("label", position, low=1),
        mesh=mesh,
        concave=section.flag("concave") if "concave" in section.values else holds_water(mesh),
        symmetries=read_symmetries(section, 1.0),
        mass=section.number("mass", _typical_mass(mesh), low=0),
        friction=section.number("friction", FRICTION, low=0),
        resting=read_resting(section, mesh),
        grasps=read_grasps(section, mesh),
        collision=read_collision(section, mesh),
    )


def _yaml_mesh(section: Section) -> Mesh:
    section.only("file", "unit")
    unit, file = section.choice("unit", tuple(UNITS)), section.text("file")
    try:
        mesh = read_mesh(section.file.parent / file, UNITS[unit])
    except Refused as error:
        section.refuse(str(error), "file")
    return _solid(mesh, section, file, unit)


def _solid(mesh: Mesh, section: Section, file: str, unit: str) -> Mesh:
    """The mesh, which is as large as what stands on tables, and has a volume."""
    middle = mesh.vertices - mesh.vertices.mean(0)
    # The last axis is the one along which it is thinnest.
    thickness = np.ptp(middle @ np.linalg.svd(middle.T @ middle)[0][:, 2])
    length = float(np.ptp(mesh.vertices, axis=0).max())
    if not SMALLEST <= length <= LARGEST:
        other = {name: length / UNITS[unit] * scale for name, scale in UNITS.items()}
        meant = [f"{name} ({size:.2g} m)" for name, size in other.items() if SMALLEST <= size <= LARGEST]
        asked = f"; is {' or '.join(meant)} meant?" if meant else ""
        section.refuse(f"{file} in {unit} is {length:.4g} m long; {SMALLEST:g} to {LARGEST:g} m are expected{asked}")
    if thickness < _FLAT:
        section.refuse(f"{file} is flat; an object has a volume")
    return mesh


def _refuse_equal_labels(listing: Section, objects: dict[str, CatalogueObject]) -> None:
    owners: dict[int, str] = {}
    for name, item in objects.items():
        if item.label in owners:
            section = listing.section(name)
            section.refuse(f"{item.label} is the label of '{owners[item.label]}' already; labels are unique", "label")
        owners[item.label] = name


def _typical_mass(mesh: Mesh) -> float:
    return _SPECIFIC_MASS * float(np.prod(np.ptp(mesh.vertices, axis=0)))


# --- BOP --------------------------------------------------------------------------------------------------------


def _read_bop(info: Path) -> dict[str, CatalogueObject]:
    root = read_section(info)
    objects: dict[str, CatalogueObject] = {}
    for key in root.values:
        if not key.isdecimal():
            root.refuse("keys of models_info.json are object numbers", key)
        objects[key] = _bop_object(root.section(key), int(key))
    _refuse_unfit_names(root, [(key, item.name) for key, item in objects.items()])
    return {item.name: item for item in objects.values()}


def _bop_object(section: Section, label: int) -> CatalogueObject:
    # Data sets add keys of their own; only what is used is checked.
    file = f"obj_{label:06d}"
    mesh = _solid(read_mesh(section.file.parent / f"{file}.ply", UNITS["mm"]), section, f"{file}.ply", "mm")
    return CatalogueObject(
        name=section.text("name", file),
        label=label,
        mesh=mesh,
        concave=section.flag("concave") if "concave" in section.values else holds_water(mesh),
        symmetries=read_symmetries(section, UNITS["mm"]),
        mass=_typical_mass(mesh),
        friction=FRICTION,
        resting=resting_rotations(mesh),
        grasps=(),
        collision=(enclosing_box(mesh),),
    )
