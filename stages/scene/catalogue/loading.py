"""Reads catalogues: our YAML format (docs/perception/catalogue.md) and the ``models`` folders of BOP data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from runner.contract import Refused
from stages.scene.catalogue.mesh_shape import holds_water, resting_rotations
from stages.scene.catalogue.objects import CatalogueObject, Mesh
from stages.scene.catalogue.ply import read_plain_ply
from stages.scene.catalogue.properties import enclosing_box, read_collision, read_grasps, read_resting, read_symmetries
from stages.scene.catalogue.sections import Section, read_section

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
FRICTION = 0.8
_GREY = (170, 170, 170)
_SPECIFIC_MASS = 300.0
"""Kilogrammes per cubic metre of the enclosing box: typical of packaged food and crockery."""
_LONGEST_PATH = 4096
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
    """A mesh of any format that trimesh reads; ``scale`` turns its lengths into metres.

    Raises:
        Refused: the file is missing, unreadable or has no triangles.
    """
    if not path.is_file():
        raise Refused(f"{path}: no such mesh file")
    return read_plain_ply(path, scale) or _read_any(path, scale)


def _read_any(path: Path, scale: float) -> Mesh:
    # Loading it takes 0.4 s, which every stage that has a catalogue would wait for at its start.
    import trimesh

    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh raises whatever its format readers raise
        formats = ", ".join(sorted(trimesh.available_formats()))
        raise Refused(f"{path}: not a readable mesh ({error}); formats are {formats}") from error
    vertices = scale * np.asarray(getattr(loaded, "vertices", ()), np.float64)
    if len(vertices) == 0 or len(loaded.faces) == 0 or not np.isfinite(vertices).all():
        raise Refused(f"{path}: a mesh with triangles and finite coordinates is expected")
    return Mesh(vertices=vertices, faces=np.asarray(loaded.faces, np.int32), colors=_vertex_colors(loaded))


def _vertex_colors(loaded: Any) -> Any:
    if loaded.visual.kind is None:
        return np.tile(np.array(_GREY, np.uint8), (len(loaded.vertices), 1))
    visual = loaded.visual.to_color() if loaded.visual.kind == "texture" else loaded.visual
    return np.ascontiguousarray(np.asarray(visual.vertex_colors, np.uint8)[:, :3])


# --- YAML -------------------------------------------------------------------------------------------------------


def _read_yaml(path: Path) -> dict[str, CatalogueObject]:
    root = read_section(path)
    root.only("objects")
    listing = root.section("objects")
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
    scale = UNITS[section.choice("unit", tuple(UNITS))]
    try:
        return read_mesh(section.file.parent / section.text("file"), scale)
    except Refused as error:
        section.refuse(str(error), "file")


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
        item = _bop_object(root.section(key), int(key))
        if item.name in objects:
            root.refuse(f"the name '{item.name}' stands there twice; names are unique", key)
        objects[item.name] = item
    return objects


def _bop_object(section: Section, label: int) -> CatalogueObject:
    # Data sets add keys of their own; only what is used is checked.
    file = f"obj_{label:06d}"
    mesh = read_mesh(section.file.parent / f"{file}.ply", UNITS["mm"])
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
