"""Looks out of a ROS 2 bag, MCAP or sqlite3: its topics are checked and paired before the first is used."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError

from runner.contract import Refused
from stages.devices.ros2.images import COMPRESSED, IMAGE
from stages.devices.ros2.rgbd import INFO, Pair, Pairs, Unusable, camera_pose, frame_of, header_stamp
from stages.devices.ros2.settings import Distribution, Source
from stages.devices.ros2.transforms import Transforms
from stages.devices.ros2.types import Types
from stages.messages import Frame

STATIC = "/tf_static"
_SHOWN = 8
_Place = tuple[int, int]
"""Where an image lies: when it was recorded, and its stamp, nanoseconds."""


class Bag:
    """The looks of one bag. Its small topics are read at once, images when they are asked for."""

    def __init__(
        self, path: Path, source: Source, distribution: Distribution, *, times: Sequence[float], period: float
    ) -> None:
        """Chooses looks by ``times``, seconds since the first, or without any one every ``period`` seconds.

        Raises:
            Refused: the file is no bag, a topic is missing or of another type, there is no look, or a time is beyond.
        """
        self._path = path
        self._source = source
        self._types = Types.of(distribution)
        self.left_out: list[str] = []
        """Of looks whose camera pose is not known: why."""
        self._reader = _opened(path)
        try:
            self._color, self._depth = (self._connection(topic, IMAGE, COMPRESSED) for topic in source.images)
            self._info = self._first(self._connection(source.info, INFO))
            self._frame_id = self._first(self._color).header.frame_id
            self._transforms = Transforms() if source.base_frame is None else self._all_transforms()
            pairs = self._placed()
            self._start = pairs[0].stamp_ns
            self._looks = self._at(pairs, times) if times else self._every(pairs, period)
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return len(self._looks)

    def look(self, index: int) -> Frame:
        """Reads a look; raises Refused naming what cannot be used."""
        found = self._looks[index]
        color, depth = self._image(self._color, found.color), self._image(self._depth, found.depth)
        pair = Pair(found.stamp_ns, color, depth)
        name = f"{self._seconds(found):.3f} s"
        try:
            return frame_of(self._source, pair, self._info, self._transforms, name=name, index=index, total=len(self))
        except Unusable as error:
            raise Refused(f"{self._path}: {error}") from None

    def close(self) -> None:
        """Closes the file."""
        self._reader.close()

    def _connection(self, topic: str, *types: str) -> Connection:
        """The one of a topic, checked."""
        found = next((one for one in self._reader.connections if one.topic == topic), None)
        if found is None:
            raise Refused(f"{self._path}: has no topic {topic}; {self._alternatives(types)}")
        if found.msgtype not in types:
            raise Refused(f"{self._path}: {topic} is of type {found.msgtype}; wanted is {' or '.join(types)}")
        ours = self._types.hash(found.msgtype)
        if found.digest and found.digest != ours:
            raise Refused(f"{self._path}: {topic}: {found.msgtype} has hash {found.digest} there and {ours} here")
        return found

    def _alternatives(self, types: Sequence[str]) -> str:
        fitting = sorted(one.topic for one in self._reader.connections if one.msgtype in types)
        topics = fitting or sorted(one.topic for one in self._reader.connections)
        more = f" and {len(topics) - _SHOWN} more" if topics[_SHOWN:] else ""
        kind = f"of type {' or '.join(types)}" if fitting else "in all"
        return f"there are {kind}: {', '.join(topics[:_SHOWN]) or 'none'}{more}"

    def _first(self, connection: Connection) -> Any:
        for message in self._messages([connection]):
            return message
        raise Refused(f"{self._path}: {connection.topic} has no message")

    def _all_transforms(self) -> Transforms:
        transforms = Transforms()
        for static in (False, True):
            topic = STATIC if static else "/tf"
            for message in self._messages([one for one in self._reader.connections if one.topic == topic]):
                transforms.add(message, static=static)
        return transforms

    def _messages(self, connections: list[Connection]) -> Iterator[Any]:
        if not connections:
            return  # rosbags would give all there are
        for connection, _, data in self._reader.messages(connections):
            yield self._decoded(connection, data)

    def _paired(self) -> Iterator[Pair]:
        pairs = Pairs(self._source.slop)
        for connection, time, data in self._reader.messages([self._color, self._depth]):
            stamp = header_stamp(data)
            pair = pairs.add(stamp, (time, stamp), is_depth=connection.topic == self._depth.topic)
            if pair is not None:
                yield pair

    def _placed(self) -> list[Pair]:
        """The pairs at whose time it is known where the camera stood."""
        found: list[Pair] = []
        for pair in self._paired():
            try:
                camera_pose(self._source, self._frame_id, pair.stamp_ns, self._transforms)
                found.append(pair)
            except Unusable as error:
                self.left_out.append(str(error))
        if not found:
            nothing = f"no two images of {self._color.topic} and {self._depth.topic} within {self._source.slop:g} s"
            raise Refused(f"{self._path}: {self.left_out[0] if self.left_out else nothing}")
        return found

    def _at(self, pairs: list[Pair], times: Sequence[float]) -> list[Pair]:
        """Of each time the first look then or later."""
        known = [self._seconds(pair) for pair in pairs]
        for time in times:
            if time > known[-1]:
                raise Refused(f"{self._path}: has no look after {time:g} s; the last one is at {known[-1]:.3f} s")
        return [pairs[bisect_left(known, time)] for time in times]

    def _every(self, pairs: list[Pair], period: float) -> list[Pair]:
        chosen = [pairs[0]]
        for pair in pairs[1:]:
            if self._seconds(pair) >= self._seconds(chosen[-1]) + period:
                chosen.append(pair)
        return chosen

    def _seconds(self, pair: Pair) -> float:
        """Since the first look."""
        return (pair.stamp_ns - self._start) / 1e9

    def _image(self, connection: Connection, place: _Place) -> Any:
        time, stamp = place
        images = (data for _, _, data in self._reader.messages([connection], time, time + 1))
        return self._decoded(connection, next(data for data in images if header_stamp(data) == stamp))

    def _decoded(self, connection: Connection, data: bytes) -> Any:
        try:
            return self._types.decode(data, connection.msgtype)
        except ValueError as error:
            raise Refused(f"{self._path}: {connection.topic}: {error}") from None


def _opened(path: Path) -> Reader:
    if not path.exists():
        raise Refused(f"{path}: no such bag; a bag is a folder with metadata.yaml, or a file .mcap or .db3")
    try:
        reader = Reader(path)
        reader.open()
    except (ReaderError, OSError) as error:
        raise Refused(f"{path}: is no ROS 2 bag that can be read: {error}") from None
    return reader
