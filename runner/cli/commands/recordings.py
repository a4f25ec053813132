"""Commands on recordings: ``info``, ``view``, ``recover``, ``why``, ``latency``, ``diff``, ``export``."""

import argparse
from pathlib import Path

from runner.cli.commands import Commands, add, add_file, add_recordings
from runner.contract import Refused


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    add_file(add(commands, "info", _info, "say what a recording holds and whether it is complete"))

    view = add(commands, "view", _view, "show a recording, or a graph while it runs")
    view.add_argument("file", type=Path, metavar="FILE", nargs="?", help="a recording")
    when = view.add_mutually_exclusive_group()
    when.add_argument("--live", action="store_true", help="follow the run that is being recorded")
    when.add_argument("--at", metavar="ID", help="nothing that came after a message, for example executor.outcome#2")
    view.add_argument("--save", type=Path, metavar="RRD", help="write a Rerun file instead of opening the viewer")
    view.add_argument("--png", type=Path, metavar="PNG", help="write a picture instead of opening the viewer")

    recover = add(commands, "recover", _recover, "write what a torn or damaged recording holds as a clean one")
    add_file(recover)
    recover.add_argument("out", type=Path, metavar="OUT", nargs="?", help="by default FILE.recovered.mcap")

    why = add(commands, "why", _why, "print the tree of causes of a message, with what each hop cost")
    why.add_argument("id", metavar="ID", help="a message, for example ranker.scene_estimate#0")
    why.add_argument("file", type=Path, metavar="FILE", nargs="?", help="a recording; the newest by default")
    add_recordings(why, "where the newest is looked for")

    add_file(add(commands, "latency", _latency, "say how long messages queue, travel and are worked on"))

    diff = add(commands, "diff", _diff, "say where two recordings differ first, and how each field differs")
    for name in ("a", "b"):
        diff.add_argument(name, type=Path, metavar=name.upper(), help="a recording")

    export = add(commands, "export", _export, "write what a recording shows in the format of another tool")
    add_file(export)
    text = "an MCAP file of Foxglove messages: images, cameras, point clouds, transforms, scenes and logs"
    formats = export.add_mutually_exclusive_group(required=True)
    formats.add_argument("--foxglove", type=Path, metavar="OUT", help=text)
    formats.add_argument(
        "--ros2", type=Path, metavar="OUT", help="a ROS 2 bag, a folder, of what the graph's views say"
    )


def _info(options: argparse.Namespace) -> None:
    from runner.inspect.info import describe

    print(describe(options.file))


def _view(options: argparse.Namespace) -> None:
    from runner.view.views import require_viewer

    require_viewer()
    from runner.view.rerun_view import STDOUT, view_live, view_recording

    for option, path, suffix in (("--save", options.save, ".rrd"), ("--png", options.png, ".png")):
        if path is not None and path.suffix != suffix and (option, path) != ("--save", STDOUT):
            raise Refused(f"{option} {path}: must end in {suffix}")
    if options.live and options.png:
        raise Refused("runner view: --png shows a graph that has ended; with --live valid: --save")
    if options.live:
        view_live(options.file, options.save)
    elif options.file is None:
        raise Refused("runner view: name a recording, or --live")
    else:
        view_recording(options.file, at=options.at, save=options.save, png=options.png)


def _recover(options: argparse.Namespace) -> None:
    from runner.recording.recover import recover

    recording, target = recover(options.file, options.out)
    print(f"{options.file}: {recording.verdict}")
    print(f"{target}: {len(recording.messages)} messages, {len(recording.steps)} steps, {len(recording.log)} log lines")


def _why(options: argparse.Namespace) -> None:
    from runner.inspect.causes import Causes
    from runner.inspect.logs import newest_recording
    from runner.recording.recording import Recording

    recording = Recording(options.file or newest_recording(options.recordings))
    print(*Causes(recording).tree_of(options.id), sep="\n")


def _latency(options: argparse.Namespace) -> None:
    from runner.inspect.latency import latency

    print(*latency(options.file), sep="\n")


def _diff(options: argparse.Namespace) -> int:
    from runner.inspect.diff import diff

    return diff(options.a, options.b)


def _export(options: argparse.Namespace) -> None:
    if options.ros2 is not None:
        from runner.view.ros2_bag import export_bag

        print(*export_bag(options.file, options.ros2), sep="\n")
        return
    from runner.view.views import require

    require("foxglove", "runner export: the Foxglove SDK", "foxglove")
    from runner.view.export import export

    if options.foxglove.suffix != ".mcap":
        raise Refused(f"--foxglove {options.foxglove}: must end in .mcap")
    print(*export(options.file, options.foxglove), sep="\n")
