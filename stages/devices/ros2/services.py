"""Services and actions: asking other nodes, and answering them.

A call that is under way ends when its server is gone; nothing waits for ever on a peer that died.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any

import zenoh

from stages.devices.ros2.node import Node, Received
from stages.devices.ros2.wire import LATCHED, Attachment, Endpoint, Qos

LONG_SECONDS = 30 * 24 * 3600.0
"""How long Zenoh waits for the result of an action, which may take as long as it takes."""
_KEPT_GOALS = 16
STATUSES = ("unknown", "accepted", "executing", "canceling", "succeeded", "canceled", "aborted")
"""Of a goal, by number: action_msgs/msg/GoalStatus."""
CANCEL = "action_msgs/srv/CancelGoal"
_REJECTED = 1
"""Of its return codes; those above say that there is no such goal any more."""


class Unanswered(Exception):
    """A call that got no answer; one line that names the service and why."""


class Request:
    """A call of this node's service, to be answered once, now or later."""

    def __init__(
        self, query: zenoh.Query, message: Any, attachment: Attachment, node: Node, endpoint: Endpoint
    ) -> None:
        self.message = message
        self.service = endpoint.topic
        self._query = query
        self._attachment = attachment
        self._node = node
        self._key = endpoint.key

    def answer(self, response: Any) -> None:
        """Sends the response to who asked."""
        attachment = Attachment(self._attachment.number, time.time_ns(), self._attachment.gid)
        self._query.reply(self._key, self._node.types.encode(response), attachment=bytes(attachment))
        self._query.drop()


def serve(node: Node, name: str, type: str, take: Callable[[Request], None]) -> None:
    """Offers a service: hands every request to ``take``, on a thread of the session."""
    endpoint = node.endpoint("SS", name, type, Qos())

    def on_query(query: zenoh.Query) -> None:
        try:
            attachment = Attachment.parse(b"" if query.attachment is None else query.attachment.to_bytes())
            payload = b"" if query.payload is None else query.payload.to_bytes()
            message = node.types.decode(payload, f"{type}_Request")
        except ValueError as error:
            node.warn(f"{endpoint.topic}: a request is left out: {error}")
            query.reply_err(str(error))
            query.drop()
            return
        take(Request(query, message, attachment, node, endpoint))

    node.keep(node.session.declare_queryable(endpoint.key, on_query, complete=True))
    node.announce(endpoint)


class Client:
    """Calls a service of another node."""

    def __init__(self, node: Node, name: str, type: str) -> None:
        self._node = node
        self._type = type
        self.endpoint = node.endpoint("SC", name, type, Qos())
        node.announce(self.endpoint)
        self.name = self.endpoint.topic
        self._numbers = itertools.count(1)

    def call(self, *, seconds: float, **request: Any) -> Any:
        """The response to a request with these fields; waits for the server, then for its answer.

        Raises:
            Unanswered: nobody serves it, no answer came in time, or the server went away meanwhile.
        """
        obstacle = self._node.wait_for(self.endpoint, seconds)
        if obstacle:
            raise Unanswered(obstacle)
        future = self.start(seconds=seconds, **request)
        try:
            return future.result(seconds + 1.0)
        except FutureTimeoutError:
            raise Unanswered(f"{self.name}: no answer within {seconds:g} s") from None

    def start(self, *, seconds: float, **request: Any) -> Future[Any]:
        """Sends a request; the future holds the response, or raises :class:`Unanswered`."""
        future: Future[Any] = Future()
        begun = time.monotonic()

        def on_reply(reply: zenoh.Reply) -> None:
            try:
                if reply.err is not None:
                    raise ValueError(reply.err.payload.to_string())
                payload = reply.result.payload.to_bytes()
                self._settle(future, self._node.types.decode(payload, f"{self._type}_Response"))
            except ValueError as error:
                self._settle(future, Unanswered(f"{self.name}: {error}"))

        def on_end() -> None:
            late = time.monotonic() - begun >= seconds
            why = f"no answer within {seconds:g} s" if late else "the server went away before it answered"
            self._settle(future, Unanswered(f"{self.name}: {why}"))

        message = self._node.types.new(f"{self._type}_Request", **request)
        self._node.session.get(
            self.endpoint.key,
            zenoh.handlers.Callback(on_reply, on_end),
            payload=self._node.types.encode(message),
            attachment=bytes(Attachment(next(self._numbers), time.time_ns(), self.endpoint.gid)),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=seconds,
        )
        return future

    @staticmethod
    def _settle(future: Future[Any], settled: Any) -> None:
        """The first word counts. All come on one thread."""
        if future.done():
            return
        if isinstance(settled, Unanswered):
            future.set_exception(settled)
        else:
            future.set_result(settled)


class Goal:
    """A goal that an action server has accepted."""

    def __init__(self, client: ActionClient, id: bytes, result: Future[Any]) -> None:
        self._client = client
        self._id = id
        self._result = result

    def result(self, seconds: float) -> tuple[str, Any]:
        """How it ended, a word of :data:`STATUSES`, and its result.

        Raises:
            Unanswered: the server went away.
            TimeoutError: it has not ended after so many seconds; ask again, or cancel.
        """
        response = self._result.result(seconds)
        return STATUSES[response.status], response.result

    def cancel(self, seconds: float) -> bool:
        """Asks the server to give the goal up; False where it will not. :meth:`result` says how it ended.

        Raises:
            Unanswered: no answer came.
        """
        return self._client.cancel(self._id, seconds=seconds)


class ActionClient:
    """Sends goals to an action server of another node."""

    def __init__(self, node: Node, name: str, type: str) -> None:
        self._node = node
        self._type = type
        self.name = name
        parts = f"{name}/_action"
        self._send = Client(node, f"{parts}/send_goal", f"{type}_SendGoal")
        self._get = Client(node, f"{parts}/get_result", f"{type}_GetResult")
        self._cancel = Client(node, f"{parts}/cancel_goal", CANCEL)
        self._feedback: OrderedDict[bytes, Callable[[Any], None]] = OrderedDict()
        """By goal, also of goals that have ended: their last feedback may come after their result."""
        self._changing = threading.Lock()
        node.subscribe(f"{parts}/feedback", f"{type}_FeedbackMessage", self._on_feedback)
        node.subscribe(f"{parts}/status", "action_msgs/msg/GoalStatusArray", lambda _: None, LATCHED)

    def send(self, id: bytes, *, seconds: float, feedback: Callable[[Any], None] | None = None, **goal: Any) -> Goal:
        """Sends a goal with these fields under an id of 16 bytes; returns it once it is accepted.

        ``feedback`` takes what the server says on the way, on a thread of the session.

        Raises:
            Unanswered: nobody serves the action, no answer came in time, or the goal was rejected.
        """
        if feedback is not None:
            with self._changing:
                self._feedback[id] = feedback
                if len(self._feedback) > _KEPT_GOALS:
                    self._feedback.popitem(last=False)
        uuid = {"uuid": list(id)}
        goal_message = self._node.types.new(f"{self._type}_Goal", **goal)
        response = self._send.call(seconds=seconds, goal_id=uuid, goal=goal_message)
        if not response.accepted:
            raise Unanswered(f"{self._send.name}: the goal was rejected")
        return Goal(self, id, self._get.start(seconds=LONG_SECONDS, goal_id=uuid))

    def cancel(self, id: bytes, *, seconds: float) -> bool:
        """Asks the server to give a goal up, of which nobody needs to know whether it was accepted; False where it
        will not.

        Raises:
            Unanswered: no answer came.
        """
        return self._cancel.call(seconds=seconds, goal_info={"goal_id": {"uuid": list(id)}}).return_code != _REJECTED

    def _on_feedback(self, received: Received) -> None:
        with self._changing:
            take = self._feedback.get(received.message.goal_id.uuid.tobytes())
        if take is not None:
            take(received.message.feedback)
