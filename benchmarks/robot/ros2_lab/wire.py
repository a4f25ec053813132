"""ROS 2 as rmw_zenoh speaks it, written for the lab alone: what the product understands is not what it has said itself.

Message definitions and CDR are those of rosbags; the texts that rosbags lacks are read from the product's file.
"""

from __future__ import annotations

import itertools
import json
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
import yaml
import zenoh
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from zenoh import ext

_TEXTS = Path(__file__).parents[3] / "stages" / "devices" / "ros2" / "interfaces.yaml"
_UUID = ("goal_id", (Nodetype.NAME, "unique_identifier_msgs/msg/UUID"))
Handler = Callable[[Any, Callable[[Any], None]], None]
"""Takes a request and what answers it, now or later."""


def free_port() -> int:
    """One at which nobody on this machine listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def open_router(port: int) -> zenoh.Session:
    """A router as rmw_zenohd is one."""
    return _open({"mode": "router", "listen/endpoints": [f"tcp/127.0.0.1:{port}"]})


def _open(settings: dict[str, Any]) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {**settings, "scouting/multicast/enabled": False, "timestamping/enabled": True}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Interfaces:
    """Messages by name; keyword arguments make them, what is not given is zero."""

    def __init__(self) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        fields = self.store.fielddefs
        for name, (constants, parts) in list(fields.items()):
            fields[name] = constants, [(part, _as_bytes(kind)) for part, kind in parts]
        texts = yaml.safe_load(_TEXTS.read_text())
        for name, text in (texts["all"] | texts["jazzy"]).items():
            self.store.register(_definitions(name, text))

    def __call__(self, name: str, /, **given: Any) -> Any:
        made = self.store.types[name]
        parts = self.store.fielddefs[name][1]
        return made(**{part: _value(self, kind, given.get(part)) for part, kind in parts})


def _as_bytes(kind: Any) -> Any:
    if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return kind[0], (_as_bytes(kind[1][0]), kind[1][1])
    return (kind[0], ("uint8", 0)) if kind == (Nodetype.BASE, ("char", 0)) else kind


def _definitions(name: str, text: str) -> dict[str, Any]:
    package, kind, _ = name.split("/")
    nothing = [("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))]
    parts: list[Any] = []
    for section in f"\n{text}".split("\n---\n"):
        ((constants, fields),) = get_types_from_msg(section, f"{package}/msg/Part").values()
        parts.append((constants, [(field, _as_bytes(kind)) for field, kind in fields] or nothing))
    if kind == "msg":
        return {name: parts[0]}
    if kind == "srv":
        return _service(name, parts[0], parts[1])
    goal, result, feedback = ((f"{name}_{part}", Nodetype.NAME) for part in ("Goal", "Result", "Feedback"))
    made = {whole: part for (whole, _), part in zip((goal, result, feedback), parts, strict=True)}
    made[f"{name}_FeedbackMessage"] = [], [_UUID, ("feedback", (Nodetype.NAME, feedback[0]))]
    stamp = ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time"))
    sent = ([], [_UUID, ("goal", (Nodetype.NAME, goal[0]))])
    made |= _service(f"{name}_SendGoal", sent, ([], [("accepted", (Nodetype.BASE, ("bool", 0))), stamp]))
    told = ([], [("status", (Nodetype.BASE, ("int8", 0))), ("result", (Nodetype.NAME, result[0]))])
    return made | _service(f"{name}_GetResult", ([], [_UUID]), told)


def _service(name: str, request: Any, response: Any) -> dict[str, Any]:
    one, two, event = (f"{name}_{part}" for part in ("Request", "Response", "Event"))
    calls = [
        (part, (Nodetype.SEQUENCE, ((Nodetype.NAME, of), 1))) for part, of in (("request", one), ("response", two))
    ]
    info = ("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo"))
    whole = [
        (f"{part}_message", (Nodetype.NAME, of)) for part, of in (("request", one), ("response", two), ("event", event))
    ]
    return {one: request, two: response, event: ([], [info, *calls]), name: ([], whole)}


def _value(new: Interfaces, kind: Any, given: Any) -> Any:
    node, inner = kind
    if node is Nodetype.NAME:
        return given if given is not None and not isinstance(given, dict) else new(inner, **(given or {}))
    if node is Nodetype.BASE:
        return {"string": ""}.get(inner[0], 0) if given is None else given
    (element, of), size = inner
    if element is Nodetype.BASE and of[0] != "string":
        dtype = {"octet": "uint8", "byte": "uint8"}.get(of[0], of[0])
        return np.zeros(size if node is Nodetype.ARRAY else 0, dtype) if given is None else np.asarray(given, dtype)
    return [_value(new, (element, of), one) for one in given or []]


class Speaker:
    """A node at a router; domain 0, namespace /."""

    def __init__(self, endpoint: str, name: str, interfaces: Interfaces) -> None:
        self.new = interfaces
        self._session = _open({"mode": "client", "connect/endpoints": [endpoint]})
        self._zid, self._name = str(self._session.info.zid()), name
        self._numbers = itertools.count(1)
        self._kept: list[Any] = [self._token(f"0/NN/%/%/{name}")]

    def publisher(
        self, topic: str, type: str, *, latched: bool = False, reliable: bool = True, waits: bool = False
    ) -> Callable[[Any], None]:
        """What publishes a message of a topic; as rmw_zenoh does it leaves out what the network does not take at once,
        unless it ``waits``.
        """
        qos = f"{'' if reliable else 2}:{1 if latched else ''}:,{1 if latched else 10}:,:,:,,"
        gid = self._announce("MP", topic, type, qos)
        late: dict[str, Any] = {"cache": ext.CacheConfig(max_samples=1), "publisher_detection": True}
        control = zenoh.CongestionControl.BLOCK if waits else zenoh.CongestionControl.DROP
        publisher = ext.declare_advanced_publisher(
            self._session, self._key(topic, type), congestion_control=control, **(late if latched else {})
        )
        self._kept.append(publisher)
        count = itertools.count(1)

        def publish(message: Any) -> None:
            publisher.put(self._bytes(message, type), attachment=_attachment(next(count), gid))

        return publish

    def serve(self, service: str, type: str, handler: Handler) -> None:
        """Offers a service."""
        key = self._key(service, type)

        def on_query(query: zenoh.Query) -> None:
            assert query.attachment is not None and query.payload is not None
            number, asker = struct.unpack_from("<q", query.attachment.to_bytes())[0], query.attachment.to_bytes()[17:]
            request = self.new.store.deserialize_cdr(query.payload.to_bytes(), f"{type}_Request")

            def answer(response: Any) -> None:
                data = self._bytes(response, f"{type}_Response")
                query.reply(key, data, attachment=_attachment(number, asker))
                query.drop()

            handler(request, answer)

        self._kept.append(self._session.declare_queryable(key, on_query, complete=True))
        self._announce("SS", service, type)

    def call(self, service: str, type: str, *, seconds: float) -> Any:
        """The response to an empty request; None where there is none in time. Waits for the server."""
        gid = self._announce("SC", service, type)
        until = time.monotonic() + seconds
        request = self._bytes(self.new(f"{type}_Request"), f"{type}_Request")
        while time.monotonic() < until:
            replies = self._session.get(
                self._key(service, type),
                payload=request,
                attachment=_attachment(next(self._numbers), gid),
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=until - time.monotonic(),
            )
            for reply in replies:
                if reply.ok is not None:
                    return self.new.store.deserialize_cdr(reply.ok.payload.to_bytes(), f"{type}_Response")
            time.sleep(0.5)
        return None

    def close(self) -> None:
        self._kept.clear()
        self._session.close()

    def _announce(self, kind: str, topic: str, type: str, qos: str = "::,10:,:,:,,") -> bytes:
        """Declares an endpoint; returns its gid."""
        mangled, hash = topic.replace("/", "%"), self.new.store.hash_rihs01(type)
        token = f"{next(self._numbers)}/{kind}/%/%/{self._name}/{mangled}/{_dds(type)}/{hash}/{qos}"
        self._kept.append(self._token(token))
        digest = xxhash.xxh3_128(self._whole(token).encode()).intdigest()
        return digest.to_bytes(16, "little")

    def _token(self, rest: str) -> Any:
        return self._session.liveliness().declare_token(self._whole(rest))

    def _whole(self, rest: str) -> str:
        return f"@ros2_lv/0/{self._zid}/0/{rest}"

    def _key(self, topic: str, type: str) -> str:
        return f"0/{topic.strip('/')}/{_dds(type)}/{self.new.store.hash_rihs01(type)}"

    def _bytes(self, message: Any, type: str) -> bytes:
        return bytes(self.new.store.serialize_cdr(message, type))


class Server:
    """An action server of one goal at a time."""

    def __init__(
        self, node: Speaker, name: str, type: str, accept: Callable[[Any], bool], cancel: Callable[[], None]
    ) -> None:
        """``accept`` takes a goal and says whether it will be done; ``cancel`` has it given up."""
        self._new, self._type, self._accept, self._cancel = node.new, type, accept, cancel
        self._id: Any = None
        self._ended: dict[bytes, Any] = {}
        self._waiting: dict[bytes, Callable[[Any], None]] = {}
        self._changing = threading.Lock()
        parts = f"{name}/_action"
        self._feedback = node.publisher(f"{parts}/feedback", f"{type}_FeedbackMessage")
        self._status = node.publisher(f"{parts}/status", "action_msgs/msg/GoalStatusArray", latched=True)
        node.serve(f"{parts}/send_goal", f"{type}_SendGoal", self._on_goal)
        node.serve(f"{parts}/get_result", f"{type}_GetResult", self._on_result)
        node.serve(f"{parts}/cancel_goal", "action_msgs/srv/CancelGoal", self._on_cancel)

    def tell(self, **feedback: Any) -> None:
        """Publishes feedback of the newest goal."""
        made = self._new(f"{self._type}_Feedback", **feedback)
        self._feedback(self._new(f"{self._type}_FeedbackMessage", goal_id=self._id, feedback=made))

    def end(self, status: int, **result: Any) -> None:
        """Ends the newest goal."""
        made = self._new(f"{self._type}_Result", **result)
        response = self._new(f"{self._type}_GetResult_Response", status=status, result=made)
        self._say(status)
        with self._changing:
            key = self._id.uuid.tobytes()
            self._ended[key] = response
            answer = self._waiting.pop(key, None)
        if answer is not None:
            answer(response)

    def _on_goal(self, request: Any, answer: Callable[[Any], None]) -> None:
        accepted = self._accept(request.goal)
        if accepted:
            self._id = request.goal_id
            self._say(2)
        answer(self._new(f"{self._type}_SendGoal_Response", accepted=accepted))

    def _on_result(self, request: Any, answer: Callable[[Any], None]) -> None:
        with self._changing:
            response = self._ended.get(request.goal_id.uuid.tobytes())
            if response is None:
                self._waiting[request.goal_id.uuid.tobytes()] = answer
        if response is not None:
            answer(response)

    def _on_cancel(self, request: Any, answer: Callable[[Any], None]) -> None:
        self._cancel()
        answer(self._new("action_msgs/srv/CancelGoal_Response", goals_canceling=[request.goal_info]))

    def _say(self, status: int) -> None:
        goal = self._new("action_msgs/msg/GoalStatus", goal_info={"goal_id": self._id}, status=status)
        self._status(self._new("action_msgs/msg/GoalStatusArray", status_list=[goal]))


def _dds(type: str) -> str:
    package, kind, name = type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _attachment(number: int, gid: bytes) -> bytes:
    return struct.pack("<qqB", number, time.time_ns(), 16) + gid


def stamp(time_ns: int) -> dict[str, int]:
    """A builtin_interfaces/Time."""
    return {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}


def transforms(new: Interfaces, parent: str, poses: dict[str, Any]) -> Any:
    """A tf2_msgs/TFMessage of now; ``poses`` (4 x 4) in the parent, by name."""
    header = {"stamp": stamp(time.time_ns()), "frame_id": parent}
    made: list[Any] = []
    for child, T in poses.items():
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        translation = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
        place = {"translation": translation, "rotation": {"x": x, "y": y, "z": z, "w": w}}
        made.append(new("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=place))
    return new("tf2_msgs/msg/TFMessage", transforms=made)
