"""Commands on graphs that run: ``ps``, ``logs``, ``topic``, ``call``, ``restart``, ``goals``, ``page``, ``down``."""

from __future__ import annotations

import argparse
import os
import shlex
from itertools import islice
from typing import TYPE_CHECKING

from runner.cli import completion
from runner.cli.commands import RECORDINGS, Commands, add, add_recordings, count, graph_file
from runner.cli.completion import completed
from runner.contract import Refused

if TYPE_CHECKING:
    from collections.abc import Iterable

    from runner.live.live import Live
    from runner.page.story import Action, Card
    from runner.supervise.calls import CallRequest


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    _add_run(add(commands, "ps", _ps, "show the graphs that run and how each of their processes is"))

    logs = add(commands, "logs", _logs, "show what the stages of the running graph say, or of the last one")
    text = "only this one, with what its processes printed"
    completed(logs.add_argument("stage", metavar="STAGE", nargs="?", help=text), completion.stages)
    logs.add_argument("-f", "--follow", action="store_true", help="go on until the graph ends")
    add_recordings(logs, "where the last run is, whatever runs now")
    logs.set_defaults(recordings=None)
    _add_run(logs)

    topic = commands.add_parser("topic", help="look at what flows", description="Look at what flows.")
    _add_verbs(topic.add_subparsers(required=True, metavar="VERB"))

    call = add(commands, "call", _call, "have a stage do what it can be asked, and wait until it is done")
    text = "without a command: lists what it can be asked"
    completed(call.add_argument("stage", metavar="STAGE", nargs="?", help=text), completion.callable_stages)
    completed(call.add_argument("name", metavar="COMMAND", nargs="?"), completion.command_names)
    fields = call.add_argument("fields", metavar="FIELD=VALUE", nargs="*", help="for example name=breakfast")
    completed(fields, completion.fields)
    _add_run(call)

    restart = add(commands, "restart", _restart, "replace a process in order: it finishes its step, nothing is lost")
    completed(restart.add_argument("process", metavar="STAGE[.REPLICA]"), completion.processes)
    _add_run(restart)

    goals = add(commands, "goals", _goals, "show what the running graph was taught, and what can be done with it")
    goals.add_argument("name", metavar="NAME", nargs="?", help="only this one")
    goals.add_argument("--delete", action="store_true", help="delete it")
    text = "what this graph keeps on disk, whether it runs or not"
    goals.add_argument("--graph", metavar="GRAPH", type=graph_file, help=text)
    _add_run(goals)

    page = add(commands, "page", _page, "serve a page on the running graph, for people who do not program")
    page.add_argument(
        "--address", default="127.0.0.1", help="where it is; beyond this machine RUNNER_PAGE_TOKEN must be set"
    )
    page.add_argument("--port", type=_port, default=0, help="any that is free by default")
    _add_run(page)

    _add_run(add(commands, "down", _down, "end a graph in order and wait until it is gone"))


def _add_verbs(verbs: Commands) -> None:
    """What can be done with topics."""
    text = "every topic with its type, its consumers and how much flows from the processes that live now"
    _add_run(add(verbs, "list", _topic_list, text))
    for name, verb, text, unit in (
        ("echo", _topic_echo, "print messages as they come, whatever their type", "messages"),
        ("hz", _topic_rate, "how often messages come, from their headers alone", "lines, one a second"),
        ("bw", _topic_rate, "how many bytes flow, from their headers alone", "lines, one a second"),
    ):
        parser = add(verbs, name, verb, text)
        parser.set_defaults(verb=name)
        completed(parser.add_argument("topic", metavar="STAGE/PORT"), completion.topics)
        parser.add_argument("-n", type=count, metavar="N", dest="count", help=f"end after so many {unit}")
        _add_run(parser)


def _add_run(parser: argparse.ArgumentParser) -> None:
    text = "which run, where there are several; the beginning of its name will do"
    completed(parser.add_argument("--run", metavar="NAME", help=text), completion.run_names)


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r}: must be 0 to 65535")
    return int(text)


def _ps(options: argparse.Namespace) -> None:
    from runner.live.live import Live
    from runner.live.tables import status_text
    from runner.supervise.registry import find_run, runs

    entries = [find_run(options.run)] if options.run else runs()
    for number, entry in enumerate(entries):
        try:
            with Live(entry) as live:
                text = status_text(entry, live.status())
        except Refused as refusal:  # it has just ended, or it hangs
            text = str(refusal)
        print("\n" * (number > 0) + text)
    if not entries:
        print("no graph is running on this machine")


def _logs(options: argparse.Namespace) -> None:
    from runner.inspect.logs import log_lines, newest_recording, printed_lines
    from runner.live.live import recording_of
    from runner.live.tables import show_lines
    from runner.supervise.registry import find_run, runs

    if options.run and options.recordings:
        raise Refused("runner logs: --run NAME or --recordings DIR, not both")
    running = options.run or (options.recordings is None and runs())
    path = recording_of(find_run(options.run)) if running else newest_recording(options.recordings or RECORDINGS)
    show_lines(path, log_lines(path, options.stage, follow=options.follow))
    if options.stage and not options.follow:
        for process, line in printed_lines(path, options.stage):
            print(f"{process} | {line}")


def _topic_list(options: argparse.Namespace) -> None:
    from runner.live.tables import topics_text

    with _reached(options) as live:
        print(topics_text(live.status()))


def _topic_echo(options: argparse.Namespace) -> None:
    from runner.inspect.echo import lines_of

    with _reached(options) as live:
        for packet in islice(live.messages(options.topic), options.count):
            print("\n".join(lines_of(packet.payload)), flush=True)


def _topic_rate(options: argparse.Namespace) -> None:
    from runner.live.tables import bandwidth_text, rate_text

    text = rate_text if options.verb == "hz" else bandwidth_text
    with _reached(options) as live:
        for headers in islice(live.headers(options.topic), options.count):
            print(text(headers), flush=True)


def _call(options: argparse.Namespace) -> int | None:
    from runner.live.tables import commands_text
    from runner.supervise.calls import CallRequest

    fields = _fields(options.fields)
    with _reached(options) as live:
        if options.name is None:
            print(commands_text(live.commands(), options.stage))
            return None
        return _called(live, CallRequest(options.stage, options.name, fields))


def _called(live: Live, request: CallRequest) -> int | None:
    from runner.live.tables import show_progress

    live.wait_until_ready(print)
    id = live.call(request)
    return show_progress(id, request.stage, live.follow(id))


def _fields(texts: list[str]) -> dict[str, str]:
    fields: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise Refused(f"{text}: expected field=value, for example name=breakfast")
        if name in fields:
            raise Refused(f"{text}: {name} is given twice")
        fields[name] = value
    return fields


def _restart(options: argparse.Namespace) -> None:
    with _reached(options) as live:
        print(live.restart(options.process))


def _goals(options: argparse.Namespace) -> int | None:
    from runner.graph.document import suggest
    from runner.graph.reading import load_graph
    from runner.live.live import recording_of
    from runner.page.watch import told_so_far, told_without_a_run
    from runner.supervise.registry import find_run

    if options.graph is not None:
        told = told_without_a_run(load_graph(options.graph), "en")
    else:
        told = told_so_far(recording_of(find_run(options.run)), "en")
    titles = [card.title for card in told.cards]
    if options.name is not None and options.name not in titles:
        raise Refused(f"{options.name}: is not remembered{suggest(options.name, titles)}")
    if options.delete:
        return _delete(options, told.cards)
    for card in told.cards:
        if options.name in (None, card.title):
            calls = (_typed(one) for one in (*card.actions, *card.more))
            print(card.title, *(f"    {line}" for line in (card.text, *calls)), sep="\n")
    if not told.cards:
        print(told.cards_hint or "this graph remembers nothing")
    return None


def _delete(options: argparse.Namespace, cards: Iterable[Card]) -> int | None:
    from runner.supervise.calls import CallRequest

    if options.name is None or options.graph is not None:
        raise Refused("runner goals --delete: name one of a graph that runs")
    actions = (action for card in cards if card.title == options.name for action in card.more)
    delete = next((action for action in actions if action.kind == "delete"), None)
    if delete is None:
        raise Refused(f"{options.name}: cannot be deleted")
    with _reached(options) as live:
        return _called(live, CallRequest(delete.stage, delete.command, delete.arguments))


def _typed(action: Action) -> str:
    """What to type instead of pressing a button."""
    asked = [] if action.ask is None else [f"{action.ask.field}=..."]
    fields = [f"{name}={shlex.quote(value)}" for name, value in action.arguments.items()] + asked
    return " ".join(["runner call", action.stage, action.command, *fields])


def _page(options: argparse.Namespace) -> None:
    from runner.page.start import require_page
    from runner.supervise.registry import find_run

    require_page()
    from runner.page.server import serve

    token = os.environ.pop("RUNNER_PAGE_TOKEN", "")
    serve(find_run(options.run), address=options.address, port=options.port, token=token)


def _down(options: argparse.Namespace) -> None:
    from runner.live.live import wait_until_gone
    from runner.live.tables import from_here

    with _reached(options) as live:
        live.down()
    wait_until_gone(live.entry)
    print(f"{live.entry.run} has ended; recording {from_here(live.entry.recording)}")


def _reached(options: argparse.Namespace) -> Live:
    """The run that is named, or the only one."""
    from runner.live.live import Live
    from runner.supervise.registry import find_run

    return Live(find_run(options.run))
