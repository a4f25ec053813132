"""Zenoh sessions as every process opens them: all that Zenoh is ever told.

The processes of one machine meet at Unix sockets in a folder that only their user may enter; between machines they meet
over mutual TLS. Whoever else listens, a tool or a stranger, does so at the run's :class:`Gateway`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import shutil
import socket
import stat
import struct
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil
import zenoh

from runner.contract import Refused
from runner.graph.placement import Network
from runner.transport.security import readers_only, security

LEASE_MS = 5000
"""A host of which nothing is heard for so long is cut off."""
PATIENCE = {
    "transport/link/tx/lease": 7 * 24 * 3600 * 1000,
    "transport/unicast/open_timeout": 600_000,
    "transport/unicast/accept_timeout": 600_000,
}
"""On one machine, milliseconds: a socket tells at once when a process has died, and one that is stopped for a while has
not. Zenoh would give up a link that is being made after 10 s, and two processes that one names to the other never try
again."""
BLOCK_FOR_US = 600_000_000
"""How long a full link blocks its sender before Zenoh gives the link up; the default of 5 s loses messages."""
CALL_MS = 10_000
"""How long a tool calls a run that does not take the call."""
CLOSE_SECONDS = 1.0
GATEWAY_BATCHES = 16
"""Of 64 KiB that may wait for a listener; the most that Zenoh allows."""
_UNIX = "unixsock-stream"


def runtime_folder() -> Path:
    """Where this user's runs are listed and have their sockets; raises Refused where others could write to it."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    usable = bool(runtime) and os.access(runtime, os.W_OK | os.X_OK)  # another user's after `su`, or gone
    folder = Path(runtime) / "runner" if usable else Path(f"/tmp/runner-{os.getuid()}")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise Refused(f"{folder}: runs cannot be listed there: {error.strerror}") from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise Refused(f"{folder}: must be a folder that only this user may enter; type: rm -rf {folder}")
    return folder


def new_endpoint(like: str = "") -> str:
    """An endpoint where nobody listens yet: a socket beside that of ``like``, or in a new folder of its own.

    Where ``like`` is an address, a free port of it.
    """
    protocol, _, address = like.partition("/")
    if protocol == "tls":
        family, *_, bare = socket.getaddrinfo(address.rpartition(":")[0].strip("[]"), 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family) as probe:
            probe.bind(bare)
            return f"{like.rpartition(':')[0]}:{probe.getsockname()[1]}"
    folder = Path(address).parent if protocol == _UNIX else runtime_folder() / secrets.token_hex(4)
    folder.mkdir(mode=0o700, exist_ok=True)
    return f"{_UNIX}/{folder}/{secrets.token_hex(4)}"


def remove_sockets(endpoint: str) -> None:
    """Removes the folder of an endpoint's sockets; nothing where it is an address, or no folder of runs."""
    protocol, _, path = endpoint.partition("/")
    folder = Path(path).parent.resolve()
    if protocol == _UNIX and folder.parent == runtime_folder().resolve():
        shutil.rmtree(folder, ignore_errors=True)


def private(endpoint: str) -> str:
    """A loopback address without TLS stands for a socket of this user: another user cannot reach it."""
    protocol, _, address = endpoint.partition("/")
    if protocol != "tcp":
        return endpoint
    folder = runtime_folder() / f"at-{hashlib.sha256(address.encode()).hexdigest()[:8]}"
    folder.mkdir(mode=0o700, exist_ok=True)
    return f"{_UNIX}/{folder}/{'meet' if not address.endswith(':0') else secrets.token_hex(4)}"


def close_dead_links_at_once() -> None:
    """Zenoh has links linger for 10 s when they are closed: to a machine that is gone, with all else standing still."""
    for found in psutil.Process().net_connections("tcp"):
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(found.fd)) as link:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, LEASE_MS)


class Gateway:
    """Where tools and strangers listen to a run, as clients.

    What one of them does not take in time is dropped: whoever stands still here costs the graph nothing. Nobody
    publishes through it, and strangers ask nothing either.
    """

    def __init__(self, endpoint: str, meeting: str, network: Network | None, public: str | None):
        """Opens at ``endpoint``, a socket of this user, and at ``public``, for everybody who reaches that."""
        mesh = [] if network is None or network.routed else [private(network.listen)]
        listen = [endpoint, *mesh, *([public] if public else [])]
        mode = "router" if network is not None and network.routed else "peer"
        dropped = {"id": "listeners", "messages": ["put"], "flows": ["egress"], "key_exprs": ["**"]}
        queue = {"data": GATEWAY_BATCHES, "data_low": GATEWAY_BATCHES}
        settings: dict[str, Any] = {
            # The others call here: they need not be told where this is, nor listeners where they are.
            "scouting/gossip/enabled": network is not None,
            "qos/network": [{**dropped, "overwrite": {"congestion_control": "drop"}}],
            "transport/link/tx/queue/size": queue,
            # Few may be coming in at a time: a stranger who calls and says nothing keeps nobody out for long.
            "transport/unicast/accept_timeout": CALL_MS,
        }
        settings |= readers_only(network, public)
        self._session = open_session(listen, [meeting], network, mode=mode, settings=settings)

    def announce(self, key: str) -> None:
        """Declares the gateway present: whoever sees that is heard by its listeners."""
        self._token = self._session.liveliness().declare_token(key)

    def close(self) -> None:
        """Lets all listeners go."""
        close_session(self._session)


def open_session(
    listen: Sequence[str],
    connect: Sequence[str],
    network: Network | None = None,
    *,
    mode: str = "peer",
    calls_once: bool = False,
    settings: Mapping[str, Any] | None = None,
) -> zenoh.Session:
    """Opens a session; raises Refused where this machine cannot listen as it is told, or nobody takes the call of one
    who ``calls_once``."""
    told: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        # A router may be started after those that call it, and whoever is called may stand still.
        "connect/timeout_ms": CALL_MS if calls_once else -1,
        "connect/exit_on_failure": calls_once,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        # Every reader would have to lock the publisher's pool in memory, and without a word gets nothing where it may
        # not; what a process reads that stands still is overwritten. See docs/runner/performance.md.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": BLOCK_FOR_US,
    }
    if network is not None and network.credentials is not None:
        told |= {"transport/link/tx/lease": LEASE_MS, **security(network, network.credentials)}
    else:
        told |= PATIENCE
    config = zenoh.Config()
    for key, value in {**told, **(settings or {})}.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join((*listen, *connect))
        reason = str(error).partition(" at /")[0]
        raise Refused(f"{where}: cannot be used: {reason}; is another graph running there?") from None


def close_session(session: zenoh.Session) -> None:
    """Closes a session; does not wait for long for peers that do not take a goodbye, or are cut off."""

    def close() -> None:
        with contextlib.suppress(zenoh.ZError):
            session.close()

    closer = threading.Thread(target=close, name="close", daemon=True)
    closer.start()
    closer.join(CLOSE_SECONDS)
