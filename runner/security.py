"""What Zenoh is told so that only the hosts of a graph take part: mutual TLS and an access-control list by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from runner.network import TOOLS, Credentials, Network

IN, OUT = ("ingress",), ("egress",)
EVERYTHING = (
    *("put", "delete", "declare_subscriber"),
    *("query", "reply", "declare_queryable"),
    *("liveliness_token", "declare_liveliness_subscriber", "liveliness_query"),
)
ASKING = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
"""What one who only watches sends."""
ANSWERING = ("put", "delete", "reply", "declare_queryable", "liveliness_token")
"""What one who only watches gets."""


def security(network: Network, credentials: Credentials) -> dict[str, Any]:
    """Settings of a Zenoh session, by key.

    Whoever shows no certificate of the graph's authority is not let in. Whoever is let in and is none of the hosts
    gets and sends nothing, but for the live tools, which watch and ask. Only the head has processes started.
    """
    others = [name for name in network.hosts if name != network.head]
    subjects = {"hosts": list(network.hosts), "others": [*others, TOOLS], "tools": [TOOLS]}
    rules = [
        _rule("take part", "allow", EVERYTHING, (*IN, *OUT)),
        _rule("ask", "allow", ASKING, IN),
        _rule("be answered", "allow", ANSWERING, OUT),
        _rule("order", "deny", ("put",), IN, keys=("hosts/*/order/**",)),
        _rule("join", "deny", ("query",), IN, keys=("hosts/*/q/join",)),
    ]
    policies = {"hosts": ["take part"], "tools": ["ask", "be answered", "join"], "others": ["order"]}
    return {
        "transport/link/tls": _tls(credentials),
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": name, "cert_common_names": names} for name, names in subjects.items()],
            "policies": [{"rules": allowed, "subjects": [name]} for name, allowed in policies.items()],
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


def _rule(
    name: str, permission: str, messages: Iterable[str], flows: Iterable[str], keys: tuple[str, ...] = ("**",)
) -> dict[str, Any]:
    return {
        "id": name,
        "permission": permission,
        "messages": list(messages),
        "flows": list(flows),
        "key_exprs": list(keys),
    }
