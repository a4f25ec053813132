"""Writes a new project: two stages with their messages, a graph, tests, and what a Python package needs."""

from __future__ import annotations

import importlib.util
import itertools
import keyword
import re
import sys
from pathlib import Path

from runner.contract import Refused

TEMPLATE = Path(__file__).with_name("template")
"""The files as they are written, but for ``NAME``, in names and texts, and for the suffix, which keeps tools off."""
SUFFIX = ".template"
PLACEHOLDER = "NAME"
OWN_FOLDERS = ("tests", "recordings")
"""Of every project; a package of that name would be in their place."""


def new_project(name: str, parent: Path) -> list[Path]:
    """Writes the project ``name`` into a folder of that name and returns its files.

    Raises Refused where the name cannot be a package's, is taken, or the folder cannot be written; nothing that is
    there is changed.
    """
    if (reason := _why_not(name, parent)) is not None:
        raise Refused(f"runner new {name}: {reason}; valid, for example: {_valid_name(name, parent)}")
    try:
        return [_write(source, name, parent / name) for source in sorted(TEMPLATE.rglob(f"*{SUFFIX}"))]
    except OSError as error:
        raise Refused(f"runner new {name}: {error.filename} cannot be written: {error.strerror}") from None


def _why_not(name: str, parent: Path) -> str | None:
    """What is wrong with a name, or nothing."""
    if not re.fullmatch(r"[a-z]([a-z0-9_]{0,62}[a-z0-9])?", name):
        return "a package's name is up to 64 lower case letters, digits and _, the first a letter, the last no _"
    if keyword.iskeyword(name) or name in OWN_FOLDERS:
        return f"{name!r} means something else in {'Python' if keyword.iskeyword(name) else 'a project'}"
    if (parent / name).exists():
        return f"{parent / name} exists, and nothing is overwritten"
    if name in sys.stdlib_module_names or importlib.util.find_spec(name) is not None:
        return f"Python has a module {name!r} already, which would be imported in its place"
    return None


def _valid_name(name: str, parent: Path) -> str:
    """The nearest name that can be taken."""
    base = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:32].rstrip("_") or "robot"
    others = itertools.chain((base, f"my_{base}"), (f"my_{base}_{number}" for number in itertools.count(2)))
    return next(other for other in others if _why_not(other, parent) is None)


def _write(source: Path, name: str, folder: Path) -> Path:
    inside = str(source.relative_to(TEMPLATE)).removesuffix(SUFFIX)
    target = folder / inside.replace(PLACEHOLDER, name)
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.open("x") as file:
        file.write(source.read_text().replace(PLACEHOLDER, name))
    return target
