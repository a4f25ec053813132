"""Why a message exists: the tree of its causes back to the look it hangs on, with what each hop cost."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from runner.inspect.info import seconds
from runner.message.codec import Step
from runner.recording.recording import Recording

INDENT = 3 * 40
"""Characters before what lies deepest; what leads to that stands below it, as far to the right."""


class Causes:
    """Which step emitted each message of a recording, and what that step had consumed."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._steps = {id: step for step in recording.steps for id in step.emitted}

    def step_of(self, id: str) -> Step | None:
        """The step that emitted a message; None where it is not journalled."""
        return self._steps.get(id)

    def inputs_of(self, id: str) -> list[tuple[str, str]]:
        """(port, id) of what led to a message; from its header, without ports, where its step is not journalled."""
        if (step := self._steps.get(id)) is not None:
            return list(step.consumed)
        recorded = id in self._recording.messages
        return [("", cause) for cause in self._recording.recorded(id).causes] if recorded else []

    def last_input(self, id: str) -> str | None:
        """What the step that emitted a message had waited for: the input that was recorded last."""
        return last_recorded(self._recording, (cause for _, cause in self.inputs_of(id)))

    def path_to(self, id: str) -> list[str]:
        """The critical path from the start of a message's lineage to it: at each step the input that came last."""
        root, path, current = self._root_of(id), dict[str, None](), id
        while current is not None and current not in path:
            path[current] = None
            current = self.last_input(current) if current != root else None
        return list(path)[::-1]

    def tree_of(self, id: str) -> Iterator[str]:
        """The tree of causes as lines: each message with the queueing, transport and computing of its step.

        It ends where the message's lineage starts, which for what is perceived is the look. What leads to a message
        twice is shown once. Raises Refused where nothing in the recording speaks of the message, or the run
        recorded none.
        """
        self._recording.require_messages()
        if id not in self._steps:
            self._recording.require(id)
        root = self._root_of(id)
        seen: set[str] = set()
        stack = [("", "", "", id)]  # chains may be longer than Python's
        while stack:
            lead, branch, port, current = stack.pop()
            repeated = current in seen
            seen.add(current)
            note = ", as above" if repeated else self._note(current, root)
            yield f"{lead}{branch}{f'{port}: ' if port else ''}{current}{note}"
            if repeated or current == root:
                continue
            below = (lead + {"": "", "├─ ": "│  ", "└─ ": "   "}[branch])[:INDENT]
            inputs = self.inputs_of(current)
            branches = ["├─ "] * (len(inputs) - 1) + ["└─ "]
            children = [(below, mark, port, cause) for mark, (port, cause) in zip(branches, inputs, strict=False)]
            stack.extend(reversed(children))

    def _root_of(self, id: str) -> str:
        return self._recording.messages[id].lineage if id in self._recording.messages else ""

    def _note(self, id: str, root: str) -> str:
        """What a message is, and what its step cost."""
        step, messages = self._steps.get(id), self._recording.messages
        kind = f"  {messages[id].type}" if id in messages else "  MISSING from the recording"
        start = ", the lineage starts here" if id == root else ""
        if step is None:
            return f"{kind}{start}"
        if not step.consumed:
            return f"{kind}, computed {seconds(step.computed_ns)}{start or ', a start'}"
        replica = f" by replica {step.replica}" if step.replica else ""
        hop = f"travelled {seconds(step.travelled_ns)}, queued {seconds(step.waited_ns)}"
        return f"{kind}, {hop}, computed {seconds(step.computed_ns)}{replica}{start}"


def last_recorded(recording: Recording, ids: Iterable[str]) -> str | None:
    """The message that was recorded last; None where there are none, or several of which none is recorded."""
    several, messages = list(ids), recording.messages
    if recorded := [id for id in several if id in messages]:
        return max(recorded, key=lambda id: messages[id].log_time_ns)
    return several[0] if len(several) == 1 else None
