"""Goals in, all that are kept on disk out: taught today or written by hand, restored tomorrow, renamed, edited and
deleted."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import msgspec

from runner.contract import Context, Refused, Stage
from stages.messages import Add, Face, Forget, Frame, Goal, Kept, Loosen, Rename, SceneGraph, Strike
from stages.messages.arrays import Rgb
from stages.planning.symbolic.pddl import goal_pddl
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.facing import faced
from stages.scene.goals import GoalFolder, check_name, default_folder, loosened, unpacked, without

QUALITY = 85
"""Of JPEG."""


class Goals(Stage):
    """The only one who reads and writes the folder; what is in it goes out whole, at the start and after every change.

    So a replay has the goals of its time, whatever has become of the folder.
    """

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Where goals are: a folder for each, with the scene, the same as PDDL, and a picture."""

        catalogue: Path = BUILT_IN
        """What goals that are written by hand may name."""
        folder: Path = field(default_factory=default_folder)

    def __init__(self, config: Config) -> None:
        self._catalogue = Catalogue.shared(config.catalogue)
        self._folder = GoalFolder(config.folder, self._catalogue)
        self._where = config.folder
        self._picture: Rgb | None = None

    def on_start(self, ctx: Context) -> Kept:
        """Reads what was taught before."""
        self._folder.put_back()
        return self._kept(ctx)

    def on_frame(self, frame: Frame) -> None:
        """The newest picture is that of the goal which comes next."""
        self._picture = frame.rgb

    def on_goal(self, goal: Goal, ctx: Context) -> Kept:
        """Keeps what was taught, with its picture; why it cannot be kept is a fault, for nobody waits for an answer."""
        try:
            return self._write(msgspec.structs.replace(goal, picture=_jpeg(self._picture)), ctx)
        except Refused as refusal:
            return self._kept(ctx, str(refusal))

    def on_forget(self, forget: Forget, ctx: Context) -> Kept:
        """Deletes a goal; one that is being restored still is."""
        self._goal(forget.name)
        self._folder.remove(forget.name)
        ctx.log(f'goal "{forget.name}" deleted')
        return self._kept(ctx)

    def on_rename(self, rename: Rename, ctx: Context) -> Kept:
        """Gives a goal another name."""
        goal = self._goal(rename.name)
        self._refuse_taken(f"to={rename.to!r}", rename.to)
        self._folder.write(_changed(rename.to, goal, goal.scene))
        self._folder.remove(rename.name)
        ctx.log(f'goal "{rename.name}" is now "{rename.to}"')
        return self._kept(ctx)

    def on_strike(self, strike: Strike, ctx: Context) -> Kept:
        """Leaves an object or a relation out."""
        goal = self._goal(strike.name)
        return self._write(_changed(goal.name, goal, without(goal.scene, strike.what)), ctx)

    def on_loosen(self, loosen: Loosen, ctx: Context) -> Kept:
        """Has something count as next to the other further from where it was shown."""
        goal = self._goal(loosen.name)
        return self._write(_changed(goal.name, goal, loosened(goal.scene, loosen.region, loosen.radius)), ctx)

    def on_face(self, face: Face, ctx: Context) -> Kept:
        """Has the side matter that an object shows, or not any more."""
        goal = self._goal(face.name)
        return self._write(_changed(goal.name, goal, faced(goal.scene, face.object, face.side)), ctx)

    def on_add(self, add: Add, ctx: Context) -> Kept:
        """Keeps a goal that was exported."""
        goal = unpacked(add.file, self._catalogue)
        name = add.name or goal.name
        self._refuse_taken(f"name={name!r}", name)
        return self._write(_changed(name, goal, goal.scene), ctx)

    def _write(self, goal: Goal, ctx: Context) -> Kept:
        ctx.log(f'goal "{goal.name}" kept in {self._folder.write(goal)}')
        return self._kept(ctx)

    def _kept(self, ctx: Context, *unwritten: str) -> Kept:
        goals, unread = self._folder.read()
        faults = (*unread, *unwritten)
        for fault in faults:
            ctx.log(fault, level="warning")
        return Kept(goals=tuple(goals.values()), faults=faults)

    def _goal(self, name: str) -> Goal:
        goals, _ = self._folder.read()
        if name not in goals:
            valid = ", ".join(goals) or "none, teach one first"
            raise Refused(f"name={name!r}: no such goal in {self._where}; valid: {valid}")
        return goals[name]

    def _refuse_taken(self, place: str, name: str) -> None:
        check_name(place, name)
        if name in self._folder.read()[0]:
            raise Refused(f"{place}: there is a goal of that name; choose another, or delete that one first")
        if self._folder.has(name):
            raise Refused(f"{place}: there is a folder of that name in {self._where} that is no goal; choose another")


def _changed(name: str, goal: Goal, scene: SceneGraph) -> Goal:
    return msgspec.structs.replace(goal, name=name, scene=scene, pddl=goal_pddl(name, scene))


def _jpeg(rgb: Rgb | None) -> bytes:
    """A picture compressed; nothing where there is none."""
    if rgb is None:
        return b""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
