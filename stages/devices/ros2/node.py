"""A node among those of ROS 2: its session, what it knows of the others, publishers and subscriptions."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh
from zenoh import ext

from runner.contract import Refused
from runner.graph.placement import Credentials
from runner.hosts.keys import credentials
from runner.transport.security import tls
from stages.devices.ros2.settings import Link, refuse_odd_name
from stages.devices.ros2.types import Types, matching
from stages.devices.ros2.wire import COUNTERPART, TOKENS, Attachment, Endpoint, Kind, Owner, Qos, full_name

CALL_SECONDS = 10.0
"""How long a router is called that does not take the call."""
HEARTBEAT_SECONDS = 0.5
"""Between what latched publishers say of their newest message, as rmw_zenoh does."""
_SHOWN = 8
"""Names in a message to people."""
_DOES: Mapping[Kind, str] = {"MP": "publishes", "MS": "subscribes to", "SS": "serves", "SC": "calls"}


@dataclass(frozen=True, slots=True)
class Received:
    """A message of a topic."""

    message: Any
    publisher: bytes
    """Its gid."""
    number: int
    """The publisher counts from 1."""
    time_ns: int
    """When it was sent, by the clock of the publisher's machine."""


class Node:
    """Present in the ROS graph until it is closed; ``warn`` takes a line about what cannot be read.

    What it hands on comes on threads of its session, one message after the other for each topic.
    """

    def __init__(self, link: Link, warn: Callable[[str], None]) -> None:
        """Raises Refused where no router takes the call, or keys do not hold."""
        self.types = Types.of(link.distribution)
        self.warn = warn
        self._link = link
        self.session = _open(link)
        namespace = f"/{link.namespace.strip('/')}"
        zid = str(self.session.info.zid())
        self.owner = Owner(domain=link.domain, session=zid, namespace=namespace, name=link.node)
        self._entities = itertools.count(1)
        self._declared: list[Any] = [self.session.liveliness().declare_token(self.owner.token)]
        """Kept, for what nobody refers to ends."""
        self._others: dict[str, Endpoint] = {}
        self._changed = threading.Condition()
        everybody = self.session.liveliness().declare_subscriber(
            f"{TOKENS}/{link.domain}/**", self._on_token, history=True
        )
        self._declared.append(everybody)

    def publisher(self, topic: str, type: str, qos: Qos | None = None) -> Publisher:
        """Declares a topic that this node publishes."""
        publisher = Publisher(self, self.endpoint("MP", topic, type, qos or Qos()))
        self.announce(publisher.endpoint)
        return publisher

    def subscribe(self, topic: str, type: str, take: Callable[[Received], None], qos: Qos | None = None) -> Endpoint:
        """Has every message of a topic handed to ``take``; of latched publishers also what they sent before.

        Only messages of the same type and hash are heard; :meth:`obstacle` says why none come.
        """
        endpoint = self.endpoint("MS", topic, type, qos or Qos())
        self.keep(
            ext.declare_advanced_subscriber(
                self.session,
                endpoint.key,
                lambda sample: self._on_sample(endpoint, sample, take),
                **_late(endpoint.qos),
            )
        )
        self.announce(endpoint)
        return endpoint

    def endpoint(self, kind: Kind, name: str, type: str, qos: Qos) -> Endpoint:
        """An endpoint of this node, its name made whole; raises Refused for no name, or a type that is not known."""
        topic = full_name(name, self.owner.namespace, self.owner.name, self._link.remap)
        refuse_odd_name(name, topic)
        hash = self.types.hash(type)
        entity = next(self._entities)
        return Endpoint(owner=self.owner, entity=entity, kind=kind, topic=topic, type=type, hash=hash, qos=qos)

    def announce(self, endpoint: Endpoint) -> None:
        """Makes an endpoint known to the others, once it takes what they send: who sees it may send."""
        self.keep(self.session.liveliness().declare_token(endpoint.token))

    def keep(self, declared: Any) -> None:
        """Holds what was declared until the node is closed."""
        self._declared.append(declared)

    def others(self, kind: Kind, topic: str | None = None) -> list[Endpoint]:
        """Endpoints of the domain that are there now, of one topic or all."""
        with self._changed:
            known = list(self._others.values())
        return [one for one in known if one.kind == kind and topic in (None, one.topic)]

    def wait_for(self, endpoint: Endpoint, seconds: float) -> str:
        """Waits for somebody who speaks with an endpoint; returns :meth:`obstacle`, empty once there is one."""
        with self._changed:
            self._changed.wait_for(lambda: not self.obstacle(endpoint), seconds)
        return self.obstacle(endpoint)

    def obstacle(self, endpoint: Endpoint) -> str:
        """Why nobody speaks with an endpoint of this node, naming what there is instead; empty where somebody does."""
        there = self.others(COUNTERPART[endpoint.kind], endpoint.topic)
        if any(one.key == endpoint.key for one in there):
            return ""
        does = _DOES[COUNTERPART[endpoint.kind]]
        if not there:
            return f"{endpoint.topic}: nobody {does} it; {self._alternatives(endpoint)}"
        one = next((one for one in there if one.type == endpoint.type), there[0])
        if one.type != endpoint.type:
            return f"{endpoint.topic}: {one.owner.full_name} {does} {one.type} there; wanted is {endpoint.type}"
        fitting = matching(one.type, one.hash)
        advice = f"set distribution: {' or '.join(fitting)}" if fitting else "that is a definition not known here"
        return (
            f"{endpoint.topic}: {one.owner.full_name} {does} {one.type} with hash {one.hash}; here, as in "
            f"{self._link.distribution}, it has {endpoint.hash}; {advice}"
        )

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._declared.clear()
        self.session.close()

    def _alternatives(self, endpoint: Endpoint) -> str:
        found = self.others(COUNTERPART[endpoint.kind])
        alike = [one for one in found if one.type == endpoint.type]
        names = sorted({one.topic for one in alike or found})
        shown = ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if names[_SHOWN:] else "")
        of = f"of type {endpoint.type}" if alike else "in all"
        return f"there are {of}: {shown}" if names else f"domain {self.owner.domain} at {self._link.router} has none"

    def _on_token(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        endpoint = Endpoint.parse(token)
        if endpoint is None or endpoint.owner.session == self.owner.session:
            return
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._others[token] = endpoint
            else:
                self._others.pop(token, None)
            self._changed.notify_all()

    def _on_sample(self, endpoint: Endpoint, sample: zenoh.Sample, take: Callable[[Received], None]) -> None:
        try:
            attachment = Attachment.parse(b"" if sample.attachment is None else sample.attachment.to_bytes())
            message = self.types.decode(sample.payload.to_bytes(), endpoint.type)
        except ValueError as error:
            self.warn(f"{endpoint.topic}: a message is left out: {error}")
            return
        take(Received(message, attachment.gid, attachment.number, attachment.time_ns))


class Publisher:
    """Sends messages of one topic, from one thread at a time."""

    def __init__(self, node: Node, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self._types = node.types
        self._numbers = itertools.count(1)
        self._publisher = ext.declare_advanced_publisher(node.session, endpoint.key, **_cached(endpoint.qos))
        node.keep(self._publisher)

    def put(self, message: Any) -> None:
        """Sends a message."""
        attachment = Attachment(next(self._numbers), time.time_ns(), self.endpoint.gid)
        self._publisher.put(self._types.encode(message), attachment=bytes(attachment))


def _late(qos: Qos) -> dict[str, Any]:
    """How a latched subscription gets what was sent before it came."""
    if not qos.latched:
        return {}
    return {
        "history": ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
        "recovery": ext.RecoveryConfig(heartbeat=True, periodic_queries=None) if qos.reliable else None,
    }


def _cached(qos: Qos) -> dict[str, Any]:
    """How a latched publisher keeps what it sent for those who come late."""
    if not qos.latched:
        return {}
    heartbeat = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_SECONDS)
    return {
        "cache": ext.CacheConfig(max_samples=qos.depth),
        "publisher_detection": True,
        "sample_miss_detection": heartbeat if qos.reliable else None,
    }


def _open(link: Link) -> zenoh.Session:
    """A client of the lab's router. It calls again for as long as it lives, should the router go."""
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [link.router],
        "connect/timeout_ms": int(CALL_SECONDS * 1000),
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
    }
    if link.keys is not None:
        settings |= {"transport/link/protocols": ["tls"], "transport/link/tls": tls(_credentials(link.keys))}
    config = zenoh.Config()
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = str(error).partition(" at /")[0]
        raise Refused(
            f"no ROS 2 router at {link.router}: {reason}; start one with `ros2 run rmw_zenoh_cpp rmw_zenohd`"
        ) from None


def _credentials(keys: Path) -> Credentials:
    return credentials(keys.absolute().parent, keys.name)
