"""Gives a stage back what it knew: executes again, silently, what earlier processes of it have done."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from runner.contract import Refused, Stage
from runner.graph.graph import Node
from runner.message.codec import Step
from runner.process.step import Executor, receive, step_time
from runner.recording.recording import Recording


def past_of(recording: Recording, stage: str, incarnation: int, *, done: int) -> list[Step]:
    """What earlier incarnations of a stage have done, in that order. What they failed at has left nothing.

    Raises Refused where fewer than the ``done`` steps are recorded.
    """
    steps = (step for step in recording.steps if step.stage == stage and step.outcome == "done")
    past = {(step.incarnation, step.number): step for step in steps if step.incarnation < incarnation}
    if len(past) < done:
        lacking = f"{len(past)} of {done} steps are recorded in {recording.path}"
        raise Refused(f"{stage} cannot be brought back to where it was: {lacking}")
    return [past[key] for key in sorted(past)]


def bring_back(node: Node, stage: Stage, seed: int, recording: Recording, steps: Iterable[Step]) -> None:
    """Executes steps and drops what they emit, so that the stage is as they left it.

    Raises Refused where a message that a step had consumed is not recorded.
    """
    folder = Path(recording.path).with_suffix("")
    executor = Executor(node, stage, seed=seed, directory=folder, log=lambda *_: None)
    handlers = {handler.name: handler for handler in node.type.handlers}
    for step in steps:
        try:
            arrivals = [receive(node.type.inputs[port], recording.envelope(id)) for port, id in step.consumed]
        except KeyError as error:
            raise Refused(f"{node.name} cannot be brought back to where it was: {error} is not recorded") from None
        with contextlib.suppress(*(Refused,) if step.error else ()):  # of a command, then as now
            for _ in executor.run(handlers[step.handler], arrivals, step_time(node, arrivals, step.time_ns)):
                pass
