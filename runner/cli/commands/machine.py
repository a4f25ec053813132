"""Commands on this machine: ``doctor``, ``completion``."""

from __future__ import annotations

import argparse

from runner.cli.commands import Commands, add, add_recordings, graph_file
from runner.cli.completion import SHELLS, script


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    doctor = add(commands, "doctor", _doctor, "say what would keep a graph from running here, and what to type")
    text = "also whether this graph could start, and what its stages need of the machine"
    doctor.add_argument("graph", type=graph_file, metavar="GRAPH", nargs="?", help=text)
    add_recordings(doctor, "where recordings go")
    shell = add(commands, "completion", _completion, "print what makes a shell complete this command")
    shell.add_argument("shell", choices=SHELLS)


def _doctor(options: argparse.Namespace) -> int:
    from runner.cli.doctor import examine, examine_graph

    findings = list(examine(options.recordings))
    findings += examine_graph(options.graph) if options.graph else ()
    for finding in findings:
        print("\n".join(finding.lines()))
    bad = sum(finding.judgement == "bad" for finding in findings)
    print(f"{bad} of {len(findings)} must be put right" if bad else "graphs can run here")
    return int(bad > 0)


def _completion(options: argparse.Namespace) -> None:
    print(script(options.shell))
