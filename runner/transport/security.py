"""What Zenoh is told so that only the hosts of a graph take part: mutual TLS and an access-control list by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from runner.graph.placement import ROUTER, Credentials, Layout, Network

EVERYTHING = (
    *("put", "delete", "declare_subscriber"),
    *("query", "reply", "declare_queryable"),
    *("liveliness_token", "declare_liveliness_subscriber", "liveliness_query"),
)
ORDERS = "hosts/*/order/**"
"""Keys on which the head has processes started."""


def security(network: Network, credentials: Credentials) -> dict[str, Any]:
    """Settings of a Zenoh session, by key.

    Whoever shows no certificate of the graph's authority is not let in. Whoever is let in and is none of the graph's
    hosts gets and sends nothing. Only the head has processes started.
    """
    # What a router sends on it has got from the head, or refused itself.
    others = [name for name in network.hosts if name not in (network.head, ROUTER)]
    rules = [
        _rule("take part", "allow", EVERYTHING, ("ingress", "egress"), "**"),
        _rule("give orders", "deny", ("put",), ("ingress",), ORDERS),
    ]
    subjects = {"hosts": list(network.hosts), **({"others": others} if others else {})}
    policies = {"hosts": "take part", "others": "give orders"}
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": _tls(credentials),
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": name, "cert_common_names": names} for name, names in subjects.items()],
            "policies": [{"rules": [policies[name]], "subjects": [name]} for name in subjects],
        },
    }


def _tls(credentials: Credentials) -> dict[str, Any]:
    """Both ends of every link show a certificate, and the one that is called must have the address it is called by."""
    sides = ("listen", "connect")
    return {
        "root_ca_certificate": credentials.ca,
        **{f"{side}_private_key": credentials.key for side in sides},
        **{f"{side}_certificate": credentials.certificate for side in sides},
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def _rule(name: str, permission: str, messages: tuple[str, ...], flows: tuple[str, ...], keys: str) -> dict[str, Any]:
    rule = {"id": name, "permission": permission, "messages": list(messages), "flows": list(flows)}
    return {**rule, "key_exprs": [keys]}


def write_router(folder: Path, layout: Layout) -> Path:
    """Writes what a router that is none of the hosts must be told; its paths are relative to where it is started."""
    own, layout = folder / ROUTER, replace(layout, keys=folder)
    credentials = Credentials(*(str(own / file) for file in ("ca.pem", "cert.pem", "key.pem")))
    config: dict[str, Any] = {
        "mode": "router",
        "listen": {"endpoints": [layout.endpoint]},
        "scouting": {"multicast": {"enabled": False}},
    }
    for key, value in security(layout.network(ROUTER, credentials), credentials).items():
        *outer, last = key.split("/")
        inner = config
        for name in outer:
            inner = inner.setdefault(name, {})
        inner[last] = value
    path = own / "zenohd.json5"
    path.write_text(json.dumps(config, indent=2))
    return path
