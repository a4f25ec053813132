"""Zenoh sessions as every process opens them: all that Zenoh is ever told."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import struct
from typing import Any

import zenoh

from runner.contract import Refused
from runner.graph.placement import Network
from runner.transport.security import security

LEASE_MS = 5000
"""A host of which nothing is heard for so long is cut off."""
BLOCK_FOR_US = 600_000_000
"""How long a full link blocks its sender before Zenoh gives the link up; the default of 5 s loses messages."""
GUEST_MS = 10_000
"""How long a guest calls a process that does not take the call."""


def free_endpoint(like: str = "tcp/127.0.0.1:0") -> str:
    """An endpoint that nothing listens on, on loopback or with the protocol and address of another one."""
    address = like.partition("/")[2].rpartition(":")[0]
    family, *_, bare = socket.getaddrinfo(address.strip("[]"), 0, type=socket.SOCK_STREAM)[0]
    with socket.socket(family) as probe:
        probe.bind(bare)
        return f"{like.rpartition(':')[0]}:{probe.getsockname()[1]}"


def close_dead_links_at_once() -> None:
    """Zenoh has links linger for 10 s when they are closed: to a machine that is gone, with all else standing still."""
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names of descriptors, not paths
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                with socket.socket(fileno=os.dup(int(name))) as link:
                    _let_go(link)


def _let_go(link: socket.socket) -> None:
    if link.family in (socket.AF_INET, socket.AF_INET6) and link.type == socket.SOCK_STREAM:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, LEASE_MS)


class Router:
    """Where the sessions of a routed network meet: it forwards between those that do not link to each other."""

    def __init__(self, endpoint: str, network: Network):
        """Raises Refused where this machine cannot listen there."""
        self._session = open_session(endpoint, None, network, mode="router")

    def close(self) -> None:
        """Lets everybody go."""
        self._session.close()


def open_session(
    listen: str | None, connect: str | None, network: Network | None, mode: str | None = None
) -> zenoh.Session:
    """Opens a session; raises Refused where this machine cannot listen as it is told."""
    config = _config(listen, connect, network, mode)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = json.loads(config.get_json("listen/endpoints")) or json.loads(config.get_json("connect/endpoints"))
        reason = str(error).partition(" at /")[0]
        raise Refused(f"{', '.join(where)}: cannot be used: {reason}; is another graph running there?") from None


def _config(listen: str | None, connect: str | None, network: Network | None, mode: str | None) -> zenoh.Config:
    routed = network is not None and network.routed
    own = network.listen if network else "tcp/127.0.0.1:0"
    mode = mode or ("client" if routed else "peer")
    settings: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": [] if mode == "client" else [listen or own],
        "connect/endpoints": [connect] if connect else [],
        # A router may be started after those that call it.
        "connect/timeout_ms": GUEST_MS if mode == "client" and not routed else -1,
        "connect/exit_on_failure": mode == "client" and not routed,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        # Of 200 messages in shared memory one or two were lost, without a word, in every second run on a busy machine.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": BLOCK_FOR_US,
    }
    if network is not None:
        settings["transport/link/tx/lease"] = LEASE_MS
    if network is not None and network.credentials is not None:
        settings |= security(network, network.credentials)
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
