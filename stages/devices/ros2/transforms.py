"""Frames and how they stand to each other over time, as the topics /tf and /tf_static tell."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stages.geometry.poses import inverse
from stages.messages.arrays import Pose


class NoTransform(Exception):
    """Two frames whose relation is not known at a time; one line that names them and what is known instead."""


@dataclass(slots=True)
class _Edge:
    """A frame in its parent; of a frame that moves, by time."""

    parent: str
    static: bool
    stamps: deque[int] = field(default_factory=deque[int])
    poses: deque[Pose] = field(default_factory=deque[Pose])


class Transforms:
    """A tree of frames; a moving one is known between its oldest and its newest stamp, and interpolated there."""

    def __init__(self, keep_seconds: float | None = None) -> None:
        """``keep_seconds`` is how long a moving frame's past is kept; None for ever."""
        self._keep_ns = None if keep_seconds is None else int(keep_seconds * 1e9)
        self._edges: dict[str, _Edge] = {}
        self._left_out: dict[str, str] = {}
        """By frame: what was said of it last and is no transform."""

    def add(self, message: Any, *, static: bool) -> None:
        """Takes a tf2_msgs/msg/TFMessage, without what is no transform in it; :meth:`lookup` says so where it lacks."""
        for one in message.transforms:
            child, parent = one.child_frame_id.lstrip("/"), one.header.frame_id.lstrip("/")
            if problem := _problem(one.transform):
                self._left_out[child] = f"{parent} to {child} has {problem}, which is no transform"
                continue
            self._left_out.pop(child, None)
            edge = self._edges.get(child)
            if edge is None or edge.parent != parent or edge.static != static:
                edge = self._edges[child] = _Edge(parent, static)
            self._insert(edge, stamp_ns(one.header), _matrix(one.transform))

    def lookup(self, to: str, source: str, at_ns: int) -> Pose:
        """``T_to_source`` at a time.

        Raises:
            NoTransform: the frames do not hang together, or a frame on the way is not known at that time.
        """
        up, down = self._ancestors(source), self._ancestors(to)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise NoTransform(self._unconnected(to, source, up, down))
        T_common_source, T_common_to = (self._pose(path, common, at_ns) for path in (up, down))
        return inverse(T_common_to) @ T_common_source

    def _insert(self, edge: _Edge, stamp: int, pose: Pose) -> None:
        if edge.static:
            edge.stamps, edge.poses = deque([stamp]), deque([pose])
            return
        if edge.stamps and stamp <= edge.stamps[-1]:
            return  # said already, or out of order
        edge.stamps.append(stamp)
        edge.poses.append(pose)
        while self._keep_ns is not None and edge.stamps[0] < stamp - self._keep_ns:
            edge.stamps.popleft()
            edge.poses.popleft()

    def _ancestors(self, frame: str) -> list[str]:
        """The frame, its parent and so on up to the root."""
        path = [frame.lstrip("/")]
        while path[-1] in self._edges and self._edges[path[-1]].parent not in path:
            path.append(self._edges[path[-1]].parent)
        return path

    def _pose(self, path: list[str], top: str, at_ns: int) -> Pose:
        return reduce(lambda T, frame: self._at(frame, at_ns) @ T, path[: path.index(top)], np.eye(4))

    def _at(self, frame: str, at_ns: int) -> Pose:
        """The frame in its parent."""
        edge = self._edges[frame]
        if edge.static:
            return edge.poses[0]
        first, last = edge.stamps[0], edge.stamps[-1]
        if not first <= at_ns <= last:
            known = f"it is from {seconds(first)} to {seconds(last)}"
            since = f"; since then {self._left_out[frame]}" if frame in self._left_out else ""
            raise NoTransform(f"{edge.parent} to {frame} is not known at {seconds(at_ns)}: {known}{since}")
        after = bisect_left(edge.stamps, at_ns)
        if edge.stamps[after] == at_ns:
            return edge.poses[after]
        before, share = after - 1, (at_ns - edge.stamps[after - 1]) / (edge.stamps[after] - edge.stamps[after - 1])
        ends = edge.poses[before], edge.poses[after]
        T = (1 - share) * ends[0] + share * ends[1]
        T[:3, :3] = Slerp([0, 1], Rotation.from_matrix([end[:3, :3] for end in ends]))(share).as_matrix()
        return T

    def _unconnected(self, to: str, source: str, up: list[str], down: list[str]) -> str:
        for root in (up[-1], down[-1]):
            if root in self._left_out:
                return self._left_out[root]
        known = sorted({*self._edges, *(edge.parent for edge in self._edges.values())})
        for frame in (to, source):
            if frame.lstrip("/") not in known:
                return f"no transform names frame {frame!r}; there are: {', '.join(known) or 'none'}"
        return f"no transform between {to!r} and {source!r}: their roots are {down[-1]!r} and {up[-1]!r}"


def stamp_ns(header: Any) -> int:
    """The stamp of a header, nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def seconds(time_ns: int) -> str:
    """A time for people."""
    return f"{time_ns / 1e9:.3f} s"


def _problem(transform: Any) -> str:
    """Why it is no transform; empty where it is one."""
    turn, place = transform.rotation, transform.translation
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    if not np.isfinite([x, y, z, w]).all() or not np.linalg.norm([x, y, z, w]) > 0:
        return f"the rotation x y z w = {x:g} {y:g} {z:g} {w:g}"
    if not np.isfinite([place.x, place.y, place.z]).all():
        return f"the translation x y z = {place.x:g} {place.y:g} {place.z:g}"
    return ""


def _matrix(transform: Any) -> Pose:
    T = np.eye(4)
    turn, place = transform.rotation, transform.translation
    T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T[:3, 3] = place.x, place.y, place.z
    return T
