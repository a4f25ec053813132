"""What Zenoh is told so that only the hosts of a graph take part: mutual TLS and an access-control list by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from runner.graph.placement import READER, ROUTER, Credentials, Layout, Network

SPEAKING = ("put", "delete", "declare_queryable", "liveliness_token")
EVERYTHING = (*SPEAKING, "declare_subscriber", "query", "reply", "declare_liveliness_subscriber", "liveliness_query")
ORDERS = "hosts/*/order/**"
"""Keys on which the head has processes started."""
QUESTIONS = "**/q/**"
"""Keys on which the head answers, as itself and for the run."""


def security(network: Network, credentials: Credentials) -> dict[str, Any]:
    """Settings of a Zenoh session, by key.

    Whoever shows no certificate of the graph's authority is not let in. Whoever is let in and is none of the graph's
    hosts gets and sends nothing. Only the head has processes started and answers.
    """
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": tls(credentials),
        **_access("deny", *_hosts(network)),
    }


def readers_only(network: Network | None, public: str | None) -> dict[str, Any]:
    """Settings of a gateway, beside those of its network: who comes in at ``public`` hears everything and says nothing.

    With keys that is whoever shows the certificate :data:`READER`; tools come in at a socket of this user.
    """
    if network is None or network.credentials is None:
        if public is None:
            return {}
        rule = _rule("say nothing", "deny", (*SPEAKING, "query"), ("ingress",), "**")
        return _access(
            "allow", [rule], [{"id": "strangers", "link_protocols": ["tcp"]}], {"strangers": ["say nothing"]}
        )
    rules, subjects, policies = _hosts(network)
    rules += [
        _rule("listen", "allow", ("declare_subscriber",), ("ingress", "egress"), "**"),
        _rule("be told", "allow", ("put", "delete"), ("egress",), "**"),
    ]
    subjects += [
        {"id": "tools", "link_protocols": ["unixsock-stream"]},
        {"id": "readers", "cert_common_names": [READER]},
    ]
    policies |= {"tools": ["take part"], "readers": ["listen", "be told"]}
    protocols = ["tls", "unixsock-stream"]
    return {"transport/link/protocols": protocols, **_access("deny", rules, subjects, policies)}


def _hosts(network: Network) -> tuple[list[Any], list[Any], dict[str, list[str]]]:
    """Rules, who there is, and which rules hold for whom: all take part, and only the head orders and answers."""
    rules = [
        _rule("take part", "allow", EVERYTHING, ("ingress", "egress"), "**"),
        _rule("give orders", "deny", ("put", "delete"), ("ingress",), ORDERS),
        _rule("answer", "deny", ("declare_queryable", "reply"), ("ingress",), QUESTIONS),
    ]
    subjects = [{"id": "hosts", "cert_common_names": list(network.hosts)}]
    policies = {"hosts": ["take part"]}
    # What a router sends on it has got from the head, or refused itself.
    if others := [name for name in network.hosts if name not in (network.head, ROUTER)]:
        subjects.append({"id": "others", "cert_common_names": others})
        policies["others"] = ["give orders", "answer"]
    return rules, subjects, policies


def _access(default: str, rules: list[Any], subjects: list[Any], policies: dict[str, list[str]]) -> dict[str, Any]:
    listed = [{"rules": names, "subjects": [subject]} for subject, names in policies.items()]
    access = {"rules": rules, "subjects": subjects, "policies": listed}
    return {"access_control": {"enabled": True, "default_permission": default, **access}}


def tls(credentials: Credentials) -> dict[str, Any]:
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
