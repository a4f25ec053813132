"""Goals on disk and in one file, for people, planners and other robots; and what of a goal may be left out."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import shutil
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from runner.contract import Refused
from runner.message.codec import CodecError, encode
from stages.messages import Goal, SceneGraph
from stages.scene.catalogue import Catalogue
from stages.scene.written import scene_of

SCENE, PDDL, PICTURE = "scene.json", "goal.pddl", "picture.jpg"
"""The files of a goal. The scene has all of it; the others are the same for planners and for people. Where there is no
scene, the PDDL is the goal, as somebody wrote it."""
MAX_BYTES = 10_000_000
"""Of a goal."""
MAX_NAME_BYTES = 100
"""Of the name of a goal, as UTF-8; most file systems take 255."""
MAX_RADIUS = 0.5
"""Metres from where it was shown at which an object may still count as next to another."""


def default_folder() -> Path:
    """Where goals are kept unless a graph says otherwise: for the user, whatever the run."""
    data = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(data).expanduser() / "scene-programming" / "goals"


def check_name(place: str, name: str) -> None:
    """Refuses what cannot be the name of a folder."""
    if not name.replace("-", "").replace("_", "").isalnum():
        raise Refused(f"{place}: must consist of letters, digits, - and _ only")
    if len(name.encode()) > MAX_NAME_BYTES:
        raise Refused(f"{place}: must have at most {MAX_NAME_BYTES} bytes as UTF-8")


class GoalFolder:
    """A folder that holds a folder for each goal. What it holds is read anew each time: others may write to it."""

    def __init__(self, folder: Path, catalogue: Catalogue) -> None:
        """``catalogue``: what goals that are written by hand may name."""
        self._folder, self._catalogue = folder, catalogue

    def read(self) -> tuple[dict[str, Goal], list[str]]:
        """All goals by name, and why what else is there is none."""
        goals, faults = dict[str, Goal](), list[str]()
        for folder in sorted({path.parent for file in (SCENE, PDDL) for path in self._folder.glob(f"[!.]*/{file}")}):
            try:
                check_name(str(folder), folder.name)
                files = {file.name: file.read_bytes() for file in folder.iterdir()}
                goals[folder.name] = goal_of(folder.name, files, self._catalogue)
            except (Refused, OSError) as error:
                faults.append(f"{folder}: {error}")
        return goals, faults

    def has(self, name: str) -> bool:
        """Whether there is something of that name, be it a goal or not."""
        return os.path.lexists(self._folder / name)

    def put_back(self) -> None:
        """Puts back what was there before a write that was broken off."""
        for old in self._folder.glob(".*.old"):
            name = old.name[1 : -len(".old")]
            with contextlib.suppress(OSError):
                _delete(old) if self.has(name) else old.rename(self._folder / name)

    def write(self, goal: Goal) -> Path:
        """Puts a goal in its folder, wholly or not at all; one of that name is replaced, what cannot be read put aside.

        Raises Refused where the disk does not take it.
        """
        place = self._folder / goal.name
        new, old = self._folder / f".{goal.name}.new", self._folder / f".{goal.name}.old"
        try:
            _delete(new)
            new.mkdir(parents=True)
            for name, content in files_of(goal).items():
                (new / name).write_bytes(content)
            if self.has(goal.name):
                _delete(old)
                place.rename(old if goal.name in self.read()[0] else self._aside(goal.name))
            new.rename(place)
            _delete(old)
        except OSError as error:
            self.put_back()
            raise Refused(f"{place}: cannot be written: {error.strerror}") from None
        return place

    def remove(self, name: str) -> None:
        """Deletes a goal; of one that is a link, the link. Raises Refused where the disk does not let go of it."""
        try:
            _delete(self._folder / f".{name}.old")
            _delete(self._folder / name)
        except OSError as error:
            raise Refused(f"{self._folder / name}: cannot be deleted: {error.strerror}") from None

    def _aside(self, name: str) -> Path:
        """Where something of that name can be left that is no goal."""
        names = (f"{name}_unread_{number}" for number in itertools.count(1))
        return self._folder / next(free for free in names if not self.has(free))


def _delete(folder: Path) -> None:
    """A folder and all that is in it, or a link to one; there may be none."""
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(folder)


def files_of(goal: Goal) -> dict[str, bytes]:
    """What is kept of a goal, by name of file."""
    scene = msgspec.json.format(msgspec.json.encode(goal.scene, enc_hook=np.ndarray.tolist), indent=1)
    return {SCENE: scene, PDDL: goal.pddl.encode()} | ({PICTURE: goal.picture} if goal.picture else {})


def goal_of(name: str, files: Mapping[str, bytes], catalogue: Catalogue) -> Goal:
    """The goal that was kept, or written by hand; raises Refused where the files are none."""
    if SCENE not in files and PDDL not in files:
        raise Refused(f"is no goal: it has neither {SCENE} nor {PDDL}")
    try:
        pddl = files.get(PDDL, b"").decode()
        scene = (
            msgspec.json.decode(files[SCENE], type=SceneGraph, dec_hook=_array)
            if SCENE in files
            else scene_of(pddl, catalogue)
        )
        goal = Goal(name=name, scene=scene, pddl=pddl, picture=files.get(PICTURE, b""))
        encode(goal)
    except Refused as refusal:
        raise Refused(f"{PDDL}: {refusal}") from None
    except (msgspec.MsgspecError, CodecError, ValueError) as error:
        raise Refused(f"is no goal: {error}") from None
    if not scene.objects:
        raise Refused("is no goal: it names no object")
    return goal


def packed(goal: Goal) -> bytes:
    """A goal as one file, a zip archive of its folder; equal goals are equal bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files_of(goal).items():
            archive.writestr(zipfile.ZipInfo(f"{goal.name}/{name}"), content, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def unpacked(file: bytes, catalogue: Catalogue) -> Goal:
    """The goal in a packed file; raises Refused where there is none."""
    try:
        with zipfile.ZipFile(io.BytesIO(file)) as archive:
            members = {tuple(one.filename.split("/")): one for one in archive.infolist()}
            folder = next((path[0] for path in members if len(path) == 2 and path[1] in (SCENE, PDDL)), "")
            if sum(one.file_size for one in members.values()) > MAX_BYTES:
                raise Refused(f"file: is no goal: unpacked it has more than {MAX_BYTES} bytes")
            files = {path[1]: archive.read(one) for path, one in members.items() if path[:-1] == (folder,)}
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError):
        raise Refused("file: is no goal: expected a file that was exported") from None
    try:
        return goal_of(folder, files, catalogue)
    except Refused as refusal:
        raise Refused(f"file: {refusal}") from None


def _array(kind: Any, value: Any) -> Any:
    return np.array(value, np.float64)


# ------------------------------------------------------------------------------------------ what does not matter


def without(scene: SceneGraph, what: str) -> SceneGraph:
    """A scene without an object, or without one of its relations.

    With an object goes all that is said of it. An object of which it is not said what carries it may be anywhere;
    regions say where it is on that, so they go with it.
    """
    if what in {item.name for item in scene.objects}:
        if len(scene.objects) == 1:
            raise Refused(f"what={what!r}: is the only object of the goal; delete the goal instead")
        regions = {item.name for item in scene.virtual_objects if what in (item.parent, item.child)}
        kept = tuple(item for item in scene.objects if item.name != what)
        return _without(msgspec.structs.replace(scene, objects=kept), {what, *regions})
    found = [item for item in scene.assertions if str(item) == what and item.predicate != "exist"]
    if not found:
        valid = [*(item.name for item in scene.objects), *(str(a) for a in scene.assertions if a.predicate != "exist")]
        raise Refused(f"what={what!r}: neither an object nor a relation of the goal; valid: {', '.join(valid)}")
    regions = {item.name: item for item in scene.virtual_objects}
    if region := next((name for name in found[0].arguments if name in regions), None):
        return _without(scene, {region})
    rest = msgspec.structs.replace(scene, assertions=tuple(item for item in scene.assertions if item not in found))
    if found[0].predicate in ("clear", "faces"):
        return rest
    return _without(rest, {name for name, item in regions.items() if item.child == found[0].arguments[0]})


def _without(scene: SceneGraph, names: Collection[str]) -> SceneGraph:
    """Without what is said of objects and regions of these names."""
    return msgspec.structs.replace(
        scene,
        virtual_objects=tuple(item for item in scene.virtual_objects if item.name not in names),
        assertions=tuple(item for item in scene.assertions if not set(names).intersection(item.arguments)),
    )


def loosened(scene: SceneGraph, region: str, radius: float) -> SceneGraph:
    """A scene in which one region has another radius."""
    names = [item.name for item in scene.virtual_objects]
    if region not in names:
        raise Refused(f"region={region!r}: no such region; valid: {', '.join(names) or 'none'}")
    if not 0 < radius <= MAX_RADIUS:
        raise Refused(f"radius={radius}: must be more than 0 and at most {MAX_RADIUS} metres")
    wider = (
        msgspec.structs.replace(item, radius=radius) if item.name == region else item for item in scene.virtual_objects
    )
    return msgspec.structs.replace(scene, virtual_objects=tuple(wider))
