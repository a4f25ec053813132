"""Commands on the keys of a network of hosts: ``keys init``, ``keys add``."""

import argparse
from pathlib import Path

from runner.cli.commands import Commands, add
from runner.contract import Refused


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    keys = commands.add_parser("keys", help="make the keys of a graph's hosts", description="Makes keys of hosts.")
    group = keys.add_subparsers(required=True, metavar="COMMAND")
    init = add(group, "init", _init, "make a private certificate authority and one certificate for each host")
    init.add_argument("what", nargs="+", metavar="GRAPH|NAME=ADDRESS", help="a graph file with hosts, or hosts")
    more = add(group, "add", _add, "make certificates for more hosts with the authority that is there")
    text = "the name of a host in the graph, and its address"
    more.add_argument("what", nargs="+", metavar="NAME=ADDRESS", help=text)
    text = "folder of the keys; without it what the graph says, else keys"
    for parser in (init, more):
        parser.add_argument("--keys", type=Path, metavar="DIR", help=text)


def _init(options: argparse.Namespace) -> None:
    from runner.graph.placement import READER, ROUTER, read_owners
    from runner.hosts.keys import make_keys
    from runner.transport.security import write_router

    layout, stated = read_owners(options.what)
    folder = options.keys or stated
    make_keys(folder, layout.certified)
    print(f"{folder}: an authority, and certificates for {', '.join(host.name for host in layout.certified)}")
    for host in layout.certified:
        print(f"  {folder / host.name}: copy this folder to {host.name} ({host.address}), to the same place there")
    if layout.certified != layout.hosts:
        print(f"  {write_router(folder, layout)}: the configuration of {ROUTER}, for zenohd --config")
    print(f"  {folder / READER}: for whoever may listen (`listen: tls/ADDRESS:PORT` in the graph), and do nothing else")
    print(f"  {folder / 'ca-key.pem'}: keep this here or put it away: who has it can make himself a host")


def _add(options: argparse.Namespace) -> None:
    from runner.graph.placement import read_owners
    from runner.hosts.keys import add_keys

    if any("=" not in what for what in options.what):
        raise Refused("runner keys add: expected hosts as NAME=ADDRESS")
    layout, stated = read_owners(options.what)
    folder = options.keys or stated
    add_keys(folder, layout.hosts)
    print(f"{folder}: certificates for {', '.join(layout.names)}; copy the folder of each to its host")
