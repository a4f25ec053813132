"""Which machines a graph runs on, where they meet, and what each of their sessions is told.

A graph file names them, the first is the head::

    hosts: {head: 10.0.0.1:7447, worker1: 10.0.0.2, worker2: 10.0.0.3}
    keys: keys
    router: head

``keys`` is the folder that ``runner keys init`` made, and turns TLS on; ``router`` says that the processes meet at a
router instead of linking to each other: the head's own, or another one by its address.
"""

import ipaddress
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from runner.contract import Refused
from runner.graph.document import Document, read_document, suggest

ROUTER = "router"
"""Common name of a router that is none of the hosts."""
READER = "reader"
"""Common name of who may listen at a run's public address, and do nothing else."""
RESERVED = (ROUTER, READER, "ca")
NAME, CHARACTERS = re.compile(r"[a-z][a-z0-9_-]*"), "lower case letters, digits, _ and -"
"""Of hosts: their keys lie in folders of these names."""


class Credentials(msgspec.Struct, frozen=True):
    """Paths of what a host shows to the others, and of whom it trusts."""

    ca: str
    certificate: str
    key: str


class Network(msgspec.Struct, frozen=True):
    """What the sessions of one host are told, beside whom to call."""

    host: str
    head: str
    hosts: tuple[str, ...]
    """Who may take part: the common names of their certificates."""
    listen: str
    """Endpoint of every session; port 0 takes a free one. Not used by those that meet at a router."""
    routed: bool = False
    """True where sessions do not link to each other, but meet at a router."""
    credentials: Credentials | None = None
    """None only where everything is on loopback."""


@dataclass(frozen=True, slots=True)
class Host:
    """One machine, and how the others reach it."""

    name: str
    address: str
    """IP address or DNS name."""
    port: int = 0

    @property
    def loopback(self) -> bool:
        """Whether only this machine reaches it."""
        return self.address == "localhost" or ((ip := _ip(self.address)) is not None and ip.is_loopback)

    def __str__(self) -> str:
        address = f"[{self.address}]" if ":" in self.address else self.address
        return f"{address}:{self.port}" if self.port else address


@dataclass(frozen=True, slots=True)
class Layout:
    """The machines of a graph; none where all of it runs where it is started."""

    hosts: tuple[Host, ...] = ()
    keys: Path | None = None
    router: Host | None = None
    """One of ``hosts`` (the head), or a machine that is none of them."""

    @property
    def head(self) -> Host:
        """The machine that has the run id, the recording and the supervisor."""
        return self.hosts[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the hosts, the head's first."""
        return tuple(host.name for host in self.hosts)

    @property
    def router_is_head(self) -> bool:
        """Whether the head is the router where all meet."""
        return self.router is not None and self.router == self.hosts[0]

    @property
    def endpoint(self) -> str:
        """Where every process calls first."""
        return self._endpoint_of(self.router or self.head)

    def network(self, name: str, credentials: Credentials | None) -> Network:
        """What the sessions of a host are told."""
        host = next(host for host in self.certified if host.name == name)
        return Network(
            host=name,
            head=self.head.name,
            hosts=tuple(host.name for host in self.certified),
            listen=self._endpoint_of(Host(name, host.address)),
            routed=self.router is not None,
            credentials=credentials,
        )

    @property
    def certified(self) -> tuple[Host, ...]:
        """Everybody who needs a certificate: the hosts, and a router that is none of them."""
        return self.hosts if self.router is None or self.router_is_head else (*self.hosts, self.router)

    def to_entry(self) -> dict[str, Any]:
        """The keys of a graph file that say this."""
        entry: dict[str, Any] = {"hosts": {host.name: str(host) for host in self.hosts}} if self.hosts else {}
        if self.keys is not None:
            entry["keys"] = str(self.keys)
        if self.router is not None:
            entry["router"] = self.router.name if self.router_is_head else str(self.router)
        return entry

    def _endpoint_of(self, host: Host) -> str:
        scheme = "tls" if self.keys is not None else "tcp"
        return f"{scheme}/{host if host.port else f'{host}:0'}"


ALONE = Layout()
"""Of a graph that names no hosts."""


def read_layout(document: Document) -> Layout:
    """Reads the hosts of a graph file; raises Refused with the place of what cannot work or is not safe."""
    layout = _read_unchecked(document)
    if not layout.hosts:
        given = next((key for key in ("keys", "router") if document.values.get(key) is not None), None)
        if given is not None:
            raise Refused(f"{document.place(given)}: says nothing without hosts; add: hosts: {{head: ADDRESS:PORT}}")
        return ALONE
    _refuse_open(document, layout)
    if layout.router in (None, layout.head) and not layout.head.port:
        head = layout.head
        place = document.place("hosts", head.name)
        raise Refused(f"{place}: the others must know where to call; add a port: {head.name}: {head}:7447")
    return layout


def _read_unchecked(document: Document) -> Layout:
    hosts = tuple(_read_host(document, name, value) for name, value in _entries(document).items())
    return Layout(hosts, _read_keys(document), _read_router(document, hosts) if hosts else None)


def read_owners(what: Sequence[str]) -> tuple[Layout, Path]:
    """Who is to have keys, from a graph file or NAME=ADDRESS, and the folder that the graph keeps them in."""
    if len(what) == 1 and "=" not in what[0]:
        document = read_document(Path(what[0]))
        layout = _read_unchecked(document)
        if not layout.hosts:
            raise Refused(f"{what[0]}: names no hosts; add: hosts: {{head: ADDRESS:PORT, worker1: ADDRESS}}")
        return layout, layout.keys or document.folder / "keys"
    pairs = [text.partition("=") for text in what]
    for name, equals, address in pairs:
        if not (re.fullmatch(NAME, name) and equals and address):
            raise Refused(f"{name}: expected one graph file, or hosts as NAME=ADDRESS, names of {CHARACTERS}")
    hosts = tuple(read_endpoint(address, f"{name}={address}", name=name) for name, _, address in pairs)
    return Layout(hosts), Path("keys")


def read_endpoint(text: str, place: str, *, name: str) -> Host:
    """``ADDRESS[:PORT]`` or ``[IPv6]:PORT``; raises Refused where it is neither."""
    match = re.fullmatch(r"\[([0-9a-fA-F:]+)\](?::(\d+))?|([\w.-]+)(?::(\d+))?", text)
    if match is None:
        raise Refused(f"{place}: {text!r} is no address; valid: 10.0.0.1, 10.0.0.1:7447, [fe80::1]:7447, name:7447")
    address, port = match[1] or match[3], int(match[2] or match[4] or 0)
    if port > 65535:
        raise Refused(f"{place}: {port} is no port; valid: 1 to 65535")
    ip = _ip(address)
    if ip is not None and ip.is_unspecified:
        raise Refused(f"{place}: nobody can call {address}; valid: the address under which the others reach {name}")
    return Host(name, address, port)


def _entries(document: Document) -> Mapping[str, Any]:
    raw = document.values.get("hosts")
    if raw is None:
        return {}
    if not isinstance(raw, dict) or not raw:
        raise Refused(f"{document.place('hosts')}: expected a mapping of names to addresses, got {raw!r}")
    return raw


def _read_host(document: Document, name: str, value: object) -> Host:
    place = document.place("hosts", name)
    if not re.fullmatch(NAME, name) or name in RESERVED:
        raise Refused(f"{place}: a host's name is {CHARACTERS}, and none of {', '.join(RESERVED)}")
    if not isinstance(value, str):
        raise Refused(f"{place}: expected ADDRESS or ADDRESS:PORT, got {value!r}")
    return read_endpoint(value, place, name=name)


def _read_keys(document: Document) -> Path | None:
    value = document.values.get("keys")
    if value is None:
        return None
    if not isinstance(value, str):
        raise Refused(f"{document.place('keys')}: expected the folder that `runner keys init` made, got {value!r}")
    return document.folder_of("keys") / Path(value).expanduser()


def _read_router(document: Document, hosts: tuple[Host, ...]) -> Host | None:
    value, place = document.values.get("router"), document.place("router")
    if value is None or value == hosts[0].name:
        return None if value is None else hosts[0]
    if any(value == host.name for host in hosts):
        raise Refused(f"{place}: {value!r} is not the head; valid: {hosts[0].name}, or ADDRESS:PORT of another router")
    router = read_endpoint(str(value), place, name=ROUTER)
    if not router.port:
        raise Refused(
            f"{place}: the port is missing; valid: {hosts[0].name}, or ADDRESS:PORT, for example {value}:7447"
        )
    return router


def _refuse_open(document: Document, layout: Layout) -> None:
    """Without keys nothing may listen where other machines can call."""
    if layout.keys is not None:
        return
    for host in (*layout.hosts, *([layout.router] if layout.router else [])):
        if not host.loopback:
            place = document.place("router") if host.name == ROUTER else document.place("hosts", host.name)
            raise Refused(
                f"{place}: {host.address} is not loopback, and without keys anybody who reaches it could take part; "
                f"type: runner keys init {document.label}, and add to the graph: keys: keys"
            )


def check_listen(document: Document, layout: Layout) -> None:
    """Raises Refused where the address at which others may listen to a graph is none, or not safe without keys."""
    value, place = document.values.get("listen"), document.place("listen")
    if value is None:
        return
    protocol, _, address = str(value).partition("/")
    if protocol not in ("tcp", "tls"):
        raise Refused(f"{place}: {value!r}: valid: tcp/127.0.0.1:7447, or with keys tls/ADDRESS:PORT")
    host = read_endpoint(address, place, name="whoever listens")
    if not host.port:
        raise Refused(f"{place}: {value!r}: the port is missing; valid: {value}:7447")
    if (protocol == "tls") != (layout.keys is not None):
        wanted = "tls/" if layout.keys is not None else "tcp/"
        why = "a graph with keys is heard over TLS" if layout.keys is not None else "TLS needs hosts and keys"
        raise Refused(f"{place}: {value!r}: {why}; valid: {wanted}{address}")
    if protocol == "tcp" and not host.loopback:
        raise Refused(
            f"{place}: {address} is not loopback, and without keys anybody who reaches it could listen; "
            f"valid: tcp/127.0.0.1:{host.port}, or hosts and keys (runner keys init)"
        )


def choose_host(layout: Layout, name: str | None, file: Path) -> str | None:
    """The host whose processes this machine starts; None where the graph names none. Raises Refused with the names."""
    if not layout.hosts:
        if name is not None:
            raise Refused(f"--host {name}: {file} names no hosts; add for example: hosts: {{{name}: 10.0.0.1:7447}}")
        return None
    if name is None and len(layout.hosts) > 1:
        raise Refused(
            f"{file} runs on {', '.join(layout.names)}: say which this machine is with --host NAME, "
            f"or run all of it here with --here"
        )
    if name is not None and name not in layout.names:
        raise Refused(f"--host {name}: no such host{suggest(name, layout.names)}")
    return name or layout.head.name


def refuse_settings(settings: tuple[str, ...], host: str) -> None:
    """Settings come from the head with each task; only how to reach it is a host's own. Raises Refused for others."""
    for setting in settings:
        key = setting.partition("=")[0]
        if not (key.startswith("hosts.") or key in ("keys", "router")):
            raise Refused(
                f"--set {setting}: settings are the head's, which gives them to {host} with its tasks; type it there"
            )


def _ip(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(address)
    except ValueError:
        return None
