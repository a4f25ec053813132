"""Shell completion: what ``runner completion SHELL`` prints, and what the shell is told when the user presses Tab."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable
from typing import Any, Literal

from runner.contract import Refused

Shell = Literal["bash", "zsh", "fish"]
SHELLS: tuple[Shell, ...] = ("bash", "zsh", "fish")
Complete = Callable[..., list[str]]
"""Gets ``prefix`` and ``parsed_args`` by keyword and returns what may stand there."""


def script(shell: Shell) -> str:
    """What the shell must read to complete ``runner``."""
    import argcomplete

    return argcomplete.shellcode(["runner"], shell=shell)


def complete_and_exit(parser: argparse.ArgumentParser) -> None:
    """Answers the shell where it is the shell that asks."""
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)


def completed(action: argparse.Action, complete: Complete) -> None:
    """Completes the values of an option or argument."""
    action.completer = complete  # type: ignore[attr-defined]


def run_names(**_: Any) -> list[str]:
    """The runs that live."""
    from runner.supervise.registry import runs

    return [entry.run for entry in runs()]


def stages(**known: Any) -> list[str]:
    """The stages of the running graph."""
    return sorted({process.stage for process in _status(known).processes})


def processes(**known: Any) -> list[str]:
    """The processes of the running graph that can be restarted."""
    return [process.name for process in _status(known).processes if process.stage != "recorder"]


def topics(**known: Any) -> list[str]:
    """The topics of the running graph."""
    return [topic.topic for topic in _status(known).topics]


def callable_stages(**known: Any) -> list[str]:
    """The stages that can be called."""
    return sorted({command.stage for command in _commands(known)})


def command_names(**known: Any) -> list[str]:
    """The commands of the stage that was typed."""
    return [command.name for command in _commands(known) if command.stage == known["parsed_args"].stage]


def fields(**known: Any) -> list[str]:
    """The fields of the command that was typed."""
    typed = known["parsed_args"]
    found = [one for one in _commands(known) if (one.stage, one.name) == (typed.stage, typed.name)]
    return [f"{field.name}=" for command in found for field in command.fields]


def _status(known: dict[str, Any]) -> Any:
    return _asked(known, "status", _Nothing())


def _commands(known: dict[str, Any]) -> list[Any]:
    return _asked(known, "commands", [])


class _Nothing:
    """The status of no run."""

    processes: tuple[Any, ...] = ()
    topics: tuple[Any, ...] = ()


def _asked(known: dict[str, Any], question: Literal["status", "commands"], nothing: Any) -> Any:
    """What the run answers; nothing where there is none or several."""
    from runner.live.live import Live
    from runner.supervise.registry import find_run

    with contextlib.suppress(Refused), Live(find_run(known["parsed_args"].run)) as live:
        return live.status() if question == "status" else live.commands()
    return nothing
