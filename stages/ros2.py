"""Scenes out to ROS 2 nodes and their wishes in: services, topics, transforms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from runner.contract import Context, Refused, Stage
from stages.devices.ros2.settings import Frames, Link
from stages.messages import (
    Asked,
    Frame,
    Goal,
    Look,
    LookRequest,
    Ros2Sent,
    SceneEstimate,
    SceneGraph,
    Verdict,
)
from stages.scene.catalogue import Catalogue
from stages.scene.text import certainty, support

if TYPE_CHECKING:  # whoever reads a graph does not load what speaks with ROS 2
    from stages.devices.ros2.services import Request


class Ros2Scenes(Stage):
    """Takes looks when ROS 2 nodes or people ask for them, and publishes their scenes."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The node, what it knows of objects and frames, and when it looks by itself."""

        catalogue: Path
        link: Link = field(default_factory=Link)
        frames: Frames = field(default_factory=Frames)
        every: float | None = None
        """Seconds from one scene to the next look; None looks only when asked."""

        def __post_init__(self) -> None:
            if self.every is not None and self.every < 0:
                raise Refused(f"ros2.every = {self.every}: must be 0 or more seconds, or null")

    def __init__(self, config: Config) -> None:
        from stages.devices.ros2.outlet import Outlet

        self._outlet = Outlet(config.link, config.frames, Catalogue.shared(config.catalogue), ("~/look",))
        self._every = config.every
        self._looks = 0
        self._waiting: dict[str, Request] = {}
        """By the purpose of their looks."""
        self._due_ns: int | None = None if config.every is None else 0
        """When the next look is taken unasked; None where none is, or one is under way."""

    def source(self, ctx: Context) -> Iterator[LookRequest | None]:
        """A look for each request of the service, and as often as it is due."""
        while True:
            asked = self._outlet.request()
            if asked is not None:
                look = self._look("asked by a node")
                self._waiting[look.purpose] = asked[1]
                yield look
            elif self._due_ns is not None and ctx.time_ns >= self._due_ns:
                self._due_ns = None
                yield self._look("due")
            else:
                yield None

    def on_look(self, look: Look, ctx: Context) -> LookRequest:
        """Takes a look."""
        return self._look("called")

    def on_scene_graph(
        self, frame: Frame, scene_estimate: SceneEstimate, scene_graph: SceneGraph, ctx: Context
    ) -> Ros2Sent:
        """Publishes a scene, and answers who asked for it."""
        sent = self._outlet.publish(frame, scene_estimate, scene_graph, ctx)
        unusable = bool(scene_graph.unusable)
        text = certainty(scene_estimate) if unusable else sentence(scene_graph)
        ctx.log(f"{frame.name}: {text}", level="warning" if unusable else "info")
        request = self._waiting.pop(frame.name, None)
        if request is not None:
            sent.append(self._outlet.answer(request, success=not unusable, message=text))
        if self._every is not None:
            self._due_ns = ctx.time_ns + int(self._every * 1e9)
        return Ros2Sent(messages=tuple(sent))

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._outlet.close()

    def _look(self, purpose: str) -> LookRequest:
        self._looks += 1
        return LookRequest(purpose=f"look {self._looks}: {purpose}")


class Ros2Demonstration(Stage):
    """Has goals taught and restored when ROS 2 nodes call services, and publishes every scene on the way."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The node, what it knows of objects and frames, and the goals that it offers."""

        catalogue: Path
        link: Link = field(default_factory=Link)
        frames: Frames = field(default_factory=Frames)
        goals: tuple[str, ...] = ("goal",)
        """Each has two services of type std_srvs/srv/Trigger: ``~/teach/GOAL`` and ``~/restore/GOAL``."""

    def __init__(self, config: Config) -> None:
        from stages.devices.ros2.outlet import Outlet

        self._services = {
            f"~/{kind}/{name}": Asked(kind=kind, name=name) for kind in ("teach", "restore") for name in config.goals
        }
        self._outlet = Outlet(config.link, config.frames, Catalogue.shared(config.catalogue), tuple(self._services))
        self._waiting: tuple[Asked, Request] | None = None
        """What is asked of the demonstrator, and who waits for it."""

    def source(self, ctx: Context) -> Iterator[Asked | Ros2Sent | None]:
        """What nodes ask for, one thing at a time; who comes meanwhile is told so."""
        while True:
            service, request = self._outlet.request() or (None, None)
            if service is None or request is None:
                yield None
            elif self._waiting is not None:
                busy = f"busy: {self._waiting[0].kind} {self._waiting[0].name} is under way"
                yield Ros2Sent(messages=(self._outlet.answer(request, success=False, message=busy),))
            else:
                asked = self._services[service]
                self._waiting = asked, request
                yield asked

    def on_scene_graph(
        self, frame: Frame, scene_estimate: SceneEstimate, scene_graph: SceneGraph, ctx: Context
    ) -> Ros2Sent:
        """Publishes a scene."""
        return Ros2Sent(messages=tuple(self._outlet.publish(frame, scene_estimate, scene_graph, ctx)))

    def on_goal(self, goal: Goal, ctx: Context) -> Ros2Sent | None:
        """Answers who had it taught."""
        if self._waiting is None or self._waiting[0] != Asked(kind="teach", name=goal.name):
            return None
        return self._answer(True, f"{len(goal.scene.objects)} objects: {sentence(goal.scene)}")

    def on_verdict(self, verdict: Verdict, ctx: Context) -> Ros2Sent | None:
        """Answers who asked for what has ended."""
        if self._waiting is None or self._waiting[0].name != verdict.goal_name:
            return None
        return self._answer(verdict.success, verdict.reason)

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._outlet.close()

    def _answer(self, success: bool, message: str) -> Ros2Sent:
        assert self._waiting is not None
        (_, request), self._waiting = self._waiting, None
        return Ros2Sent(messages=(self._outlet.answer(request, success=success, message=message),))


def sentence(scene: SceneGraph) -> str:
    """What stands where, in a line."""
    found = (f"{name} {how} {supporter}" for name, (supporter, how) in support(scene).items())
    return ", ".join(found) or "no objects"
