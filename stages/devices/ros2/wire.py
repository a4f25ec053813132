"""What ROS 2 nodes say and write on Zenoh keys: names, keys, liveliness tokens, qualities of service, attachments.

Arithmetic on strings and bytes, after https://github.com/ros2/rmw_zenoh (docs/design.md) and what genuine nodes of
Kilted were seen to send.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast, get_args

import xxhash

TOKENS = "@ros2_lv"
Kind = Literal["MP", "MS", "SS", "SC"]
"""Message publisher, message subscription, service server, service client."""
COUNTERPART: Mapping[Kind, Kind] = {"MP": "MS", "MS": "MP", "SS": "SC", "SC": "SS"}
_GID_BYTES = 16
_ATTACHMENT = struct.Struct(f"<qqB{_GID_BYTES}s")


@dataclass(frozen=True, slots=True)
class Qos:
    """What a publisher promises or a subscription asks for; what is not named here is the middleware's default."""

    reliable: bool = True
    latched: bool = False
    """Transient local: who comes late gets the newest ``depth`` messages."""
    depth: int = 10

    def __str__(self) -> str:
        return f"{'' if self.reliable else 2}:{1 if self.latched else ''}:,{self.depth}:,:,:,,"

    @classmethod
    def parse(cls, text: str) -> Qos:
        """Reads it out of a token; an empty field means the default, which is reliable, volatile, 42 messages."""
        reliability, durability, history, *_ = f"{text}::".split(":")
        depth = history.partition(",")[2]
        return cls(reliability != "2", durability == "1", int(depth) if depth.isdecimal() else 42)


SENSOR = Qos(reliable=False, depth=5)
LATCHED = Qos(latched=True, depth=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Owner:
    """The node that an endpoint belongs to, as it stands in tokens."""

    domain: int
    session: str
    """Zenoh id of its session."""
    node_id: int = 0
    namespace: str
    """``/`` or ``/a/b``."""
    name: str

    @property
    def full_name(self) -> str:
        """Namespace and name."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    @property
    def token(self) -> str:
        """Liveliness key of the node."""
        return self.token_of(self.node_id, "NN")

    def token_of(self, entity: int, kind: str) -> str:
        """Liveliness key of one of its entities, as far as it says whose it is; ``%`` is the empty enclave."""
        start = f"{TOKENS}/{self.domain}/{self.session}/{self.node_id}/{entity}"
        return f"{start}/{kind}/%/{_mangled(self.namespace)}/{self.name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoint:
    """A publisher, subscription, service or client of a node."""

    owner: Owner
    entity: int
    kind: Kind
    topic: str
    """With its leading slash; of services the service's name."""
    type: str
    """``package/msg/Name``, or with ``srv`` or ``action``."""
    hash: str
    qos: Qos

    @property
    def token(self) -> str:
        """Its liveliness key."""
        owner = self.owner.token_of(self.entity, self.kind)
        return f"{owner}/{_mangled(self.topic)}/{dds_name(self.type)}/{self.hash}/{self.qos}"

    @property
    def key(self) -> str:
        """The Zenoh key on which its messages or calls travel."""
        return f"{self.owner.domain}/{self.topic.strip('/')}/{dds_name(self.type)}/{self.hash}"

    @property
    def gid(self) -> bytes:
        """16 bytes that name it: xxh3_128 of its token, the low eight bytes first."""
        return xxhash.xxh3_128(self.token.encode()).intdigest().to_bytes(_GID_BYTES, "little")

    @classmethod
    def parse(cls, token: str) -> Endpoint | None:
        """The endpoint of a liveliness key; None where it is a node's, or of no form that is known."""
        parts = token.split("/")
        if len(parts) < 12 or parts[0] != TOKENS or parts[5] not in get_args(Kind):
            return None
        _, domain, session, node_id, entity, kind, _, namespace, name, topic, dds, hash, qos, *_ = [*parts, ""]
        if not (domain.isdecimal() and node_id.isdecimal() and entity.isdecimal()):
            return None
        owner = Owner(domain=int(domain), session=session, node_id=int(node_id), namespace=_plain(namespace), name=name)
        return cls(
            owner=owner,
            entity=int(entity),
            kind=cast("Kind", kind),
            topic=_plain(topic),
            type=ros_name(dds),
            hash=hash,
            qos=Qos.parse(qos),
        )


@dataclass(frozen=True, slots=True)
class Attachment:
    """What goes with every message, request and reply."""

    number: int
    """From 1, counted by who sent the message or the request."""
    time_ns: int
    gid: bytes
    """Of the publisher; of a reply that of the client that asked."""

    def __bytes__(self) -> bytes:
        return _ATTACHMENT.pack(self.number, self.time_ns, _GID_BYTES, self.gid)

    @classmethod
    def parse(cls, data: bytes) -> Attachment:
        """Raises ValueError where it has another form."""
        if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
            raise ValueError(f"attachment {data.hex() or 'missing'}: must be {_ATTACHMENT.size} bytes with a gid of 16")
        number, time_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(number, time_ns, gid)


def dds_name(type: str) -> str:
    """``sensor_msgs/msg/Image`` as ``sensor_msgs::msg::dds_::Image_``."""
    package, kind, name = type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(dds: str) -> str:
    """The reverse of :func:`dds_name`; what has another form stays as it is."""
    return dds.replace("::dds_::", "/").replace("::", "/").removesuffix("_")


def full_name(name: str, namespace: str, node: str, remap: Mapping[str, str]) -> str:
    """A topic's or service's whole name: ``~`` is the node, relative names are in the namespace, then remapped.

    ``remap`` leads from names, in either form, to names.
    """

    def whole(text: str) -> str:
        if text.startswith("/"):
            return text
        prefix = namespace.rstrip("/")
        return f"{prefix}/{node}/{text[1:].lstrip('/')}" if text.startswith("~") else f"{prefix}/{text}"

    renamed = {whole(old): whole(new) for old, new in remap.items()}
    return renamed.get(whole(name), whole(name))


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _plain(name: str) -> str:
    return name.replace("%", "/")
