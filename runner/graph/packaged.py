"""Files that come with installed packages: ``stages/scene/catalogue.yaml`` is found from any folder."""

import os
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from runner.contract import Refused
from runner.graph.document import suggest

GRAPHS = "runner.graphs"
"""Entry points of this group name packages with graph files: ``runner up NAME`` finds their ``NAME.yaml``."""


def locate(path: Path, folder: Path) -> Path:
    """``path`` as seen from ``folder``; where nothing is there, what an installed package has of that name."""
    near = folder / path
    if os.path.exists(near) or len(path.parts) < 2:  # noqa: PTH110 - takes any text, and Path.exists() does not
        return near
    package = _folder(path.parts[0])
    far = near if package is None else package.parent / path
    return far if far.exists() else near


def portable_name(path: Path) -> str | None:
    """What :func:`locate` finds again on any machine with the same package; None for what belongs to no package."""
    roots = (folder.parent for folder in path.parents if folder == _folder(folder.name))
    return next((str(path.relative_to(root)) for root in roots), None)


def find_graph(path: Path) -> Path:
    """The file itself where there is one, else the graph of that name in an installed package.

    Raises Refused where a bare name is neither, or a folder.
    """
    if path.suffix or len(path.parts) != 1 or (path.exists() and not path.is_dir()):
        return locate(path, Path())
    graphs = packaged_graphs()
    if path.name not in graphs and path.is_dir():
        files = ", ".join(sorted(str(file) for file in path.glob("*.yaml")))
        raise Refused(f"{path}: is a folder; valid: {files or 'a graph file'}")
    if path.name not in graphs:
        raise Refused(f"{path}: no such file, and no graph of an installed package{suggest(path.name, graphs)}")
    return graphs[path.name]


def packaged_graphs() -> dict[str, Path]:
    """The graphs of all installed packages, by name."""
    return {file.stem: file for folder in _graph_folders() for file in folder.glob("*.yaml")}


def _graph_folders() -> Iterator[Path]:
    for found in entry_points(group=GRAPHS):
        package, *inner = found.value.split(".")
        folder = _folder(package)
        if folder is not None:
            yield folder.joinpath(*inner)


def find(package: str) -> ModuleSpec | None:
    """What would be imported under a name of the top level; None where there is nothing."""
    try:
        return find_spec(package) if package.isidentifier() else None
    except (ImportError, ValueError):  # what is running as a script has no spec
        return None


def _folder(package: str) -> Path | None:
    """Where an importable package of the top level lies, without importing it; None where there is none."""
    spec = find(package)
    return Path(spec.origin).parent if spec and spec.origin and spec.submodule_search_locations else None
