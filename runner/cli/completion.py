"""Shell completion: what ``runner completion SHELL`` prints, and what the shell is told when the user presses Tab."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Literal

from runner.contract import Refused

if TYPE_CHECKING:
    from runner.live.live import Live

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
    """The runs on this machine."""
    from runner.supervise.registry import runs

    return [entry.run for entry in runs()]


def _of_run(choices: Callable[[Live, argparse.Namespace], Iterable[str]]) -> Complete:
    """What the run that was typed, or the only one, has to choose from; nothing where there is none or several."""

    def complete(*, parsed_args: argparse.Namespace, **_: Any) -> list[str]:
        from runner.live.live import Live
        from runner.supervise.registry import find_run

        with contextlib.suppress(Refused), Live(find_run(parsed_args.run)) as live:
            return list(dict.fromkeys(choices(live, parsed_args)))
        return []

    return complete


stages = _of_run(lambda live, _: (one.stage for one in live.status().processes))
processes = _of_run(lambda live, _: (one.name for one in live.status().processes if one.stage != "recorder"))
topics = _of_run(lambda live, _: (one.topic for one in live.status().topics))
callable_stages = _of_run(lambda live, _: (one.stage for one in live.commands()))
command_names = _of_run(lambda live, typed: (one.name for one in live.commands() if one.stage == typed.stage))
fields = _of_run(
    lambda live, typed: (
        f"{field.name}="
        for one in live.commands()
        if (one.stage, one.name) == (typed.stage, typed.name)
        for field in one.fields
    )
)
