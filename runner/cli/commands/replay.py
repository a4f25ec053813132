"""Commands that execute a recording again: ``replay``."""

import argparse
import os
import signal
import sys

from runner.cli.commands import Commands, add, add_file, add_settings, count
from runner.contract import Refused

_EPILOG = """\
--verify                 every stage again, every message compared byte for byte
--from, --swap, --set    what if: the changed stages and all that follows from them again, the rest as recorded
--until, --break, --step time travel: stops at a message, prints it with its causes and opens a prompt
none of these            says what a replay would execute
"""


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    replay = add(commands, "replay", _replay, "execute the stages of a recording again from what they consumed")
    replay.epilog, replay.formatter_class = _EPILOG, argparse.RawDescriptionHelpFormatter
    add_file(replay)
    add_settings(replay)
    text = "another class for a stage, for example ranker=mine:Ranker; may be given again"
    replay.add_argument("--swap", action="append", default=[], metavar="STAGE=MODULE:CLASS", dest="swaps", help=text)
    text = "execute this stage and what follows from it, changed or not; may be given again"
    replay.add_argument("--from", action="append", default=[], metavar="STAGE", dest="origins", help=text)
    replay.add_argument("--verify", action="store_true", help="compare every message byte for byte")
    text, cores = "stages executed at the same time (one a core)", len(os.sched_getaffinity(0))
    replay.add_argument("--workers", type=count, metavar="N", default=cores, help=text)
    replay.add_argument("--until", metavar="ID", help="stop at this message, for example ranker.scene_estimate#3")
    text = "stop at the first message for which this holds, for example 'ranker.scene_estimate.winner > 0'"
    replay.add_argument("--break", metavar="EXPRESSION", dest="condition", help=text)
    text = "go from message to message (Enter), from there or the start"
    replay.add_argument("--step", action="store_true", help=text)
    replay.add_argument("--prompt", action="store_true", help="open a Python prompt where it stops, terminal or not")


def _replay(options: argparse.Namespace) -> int:
    """Only saying what would be executed needs no clean process."""
    places = [place for place in (options.until, options.condition) if place is not None]
    travels = places or options.step
    changes = options.swaps or options.origins or (options.settings and not options.verify)
    if not (travels or changes or options.verify):
        from runner.replay.replay import plan

        print(*plan(options.file), sep="\n")
        return 0
    if options.verify and travels:
        raise Refused("--verify goes through the whole recording; it does not stop with --until, --break or --step")
    if len(places) > 1:
        raise Refused("--until and --break each say where to stop; give one")
    if travels and options.origins:
        raise Refused(
            "--until, --break and --step execute only the stages of the messages they stop at; valid with them: --set "
            "and --swap, not --from"
        )
    if options.verify and changes:
        raise Refused("--verify compares the recording as it is; valid with --from or --swap: nothing else")
    from runner.process.forks import become_clean

    become_clean("runner.cli", *options.arguments)
    for signum in (signal.SIGTERM, signal.SIGHUP):  # temporary folders go, too
        if signal.getsignal(signum) != signal.SIG_IGN:  # which nohup has asked for
            signal.signal(signum, lambda number, _: sys.exit(128 + number))
    execute = _travel if travels else _what_if if changes else _verify
    return execute(options)


def _verify(options: argparse.Namespace) -> int:
    from runner.replay.replay import verify

    return verify(options.file, options.settings, workers=options.workers)


def _what_if(options: argparse.Namespace) -> int:
    from runner.replay.whatif import what_if

    return what_if(
        options.file,
        assignments=options.settings,
        swaps=options.swaps,
        origins=options.origins,
        workers=options.workers,
    )


def _travel(options: argparse.Namespace) -> int:
    from runner.replay.travel import travel

    return travel(
        options.file,
        assignments=options.settings,
        swaps=options.swaps,
        until=options.until,
        condition=options.condition,
        step=options.step,
        prompt=options.prompt,
    )
