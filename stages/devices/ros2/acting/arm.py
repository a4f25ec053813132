"""An arm and a gripper behind ROS 2 controllers: goals out, joint states watched, trouble broken off and told."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

import numpy as np

from stages.devices.efforts import Efforts, Felt
from stages.devices.ros2.acting.joints import JointStates, Known
from stages.devices.ros2.acting.path import Path, Progress, duration
from stages.devices.ros2.node import Node
from stages.devices.ros2.services import CANCEL, STATUSES, ActionClient, Goal, Unanswered
from stages.devices.ros2.settings import Care, Controllers, Link
from stages.devices.ros2.wire import LATCHED
from stages.geometry.arrays import Floats
from stages.messages import RobotCommand, Ros2Message
from stages.messages.robot import Guard, Stopped
from stages.robots import Robot

FOLLOW = "control_msgs/action/FollowJointTrajectory"
DISPLAY = "moveit_msgs/msg/DisplayTrajectory"
_PIECE = 0.05
"""Seconds after which others have their turn."""
_SETTLE, _STILL = 0.25, 5e-4
"""For so long an arm has stood that moved by less, seconds, radians (metres). Fingers creep on what they hold."""
_BESIDE = 0.1
"""Radians (metres) from where a motion begins within which an arm must be: it has not been moved since it was read."""
_ALIKE, _UNLIKE = 0.003, 0.01
"""Nearer is what a gripper that has reached its goal may be off, further is another opening, metres."""
_CODES = {
    -1: "invalid goal",
    -2: "invalid joints",
    -3: "old time stamp",
    -4: "a joint left the tolerance of the path",
    -5: "a joint did not reach the tolerance of the goal",
}
"""Of a FollowJointTrajectory result."""
_HELD_UP = (-4, -5)
"""Codes of an arm that was held up: something is in its way."""


_Check = Callable[[Sequence[Known]], None]
"""Takes what is known of the joints; raises where a command is to be broken off."""


class _Broken(Exception):
    """A command that is not carried out to its end."""

    def __init__(self, stopped: Stopped, reason: str) -> None:
        super().__init__(reason)
        self.stopped: Stopped = stopped


class RemoteArm:
    """Carries out one command after the other; what it sent and heard meanwhile is in ``sent`` and ``heard``."""

    def __init__(self, link: Link, robot: Robot, controllers: Controllers, care: Care) -> None:
        """Raises Refused where there is no router."""
        self._robot, self._controllers, self._care = robot, controllers, care
        self._names = [controllers.joints.get(name, name) for name in robot.joints]
        finger = robot.gripper.fingers[0]
        self._finger = controllers.gripper_joint or controllers.joints.get(finger, finger)
        self._efforts = Efforts(robot, robot.joints, balanced=False) if controllers.efforts else None
        self.said: deque[str] = deque(maxlen=100)
        """What could not be read."""
        self.sent: list[Ros2Message] = []
        self.heard: list[Ros2Message] = []
        self._node = Node(link, self.said.append)
        self._types = self._node.types
        self._joints = JointStates(self._node, controllers.joint_states, [*self._names, self._finger], care)
        self._arm = ActionClient(self._node, controllers.trajectory, FOLLOW)
        self._gripper_type = f"control_msgs/action/{controllers.gripper_type}"
        self._gripper = ActionClient(self._node, controllers.gripper, self._gripper_type)
        self._ghosts = self._node.publisher("~/display_planned_path", DISPLAY, LATCHED)
        self._shown: list[Any] = []
        """Motions that were shown as ghosts since the encoders were read."""
        self._asked = False
        self._unstopped: tuple[ActionClient, bytes] | None = None
        """A goal that may be under way though it was to be given up."""
        self._stands = False
        """Nothing that is not known of can be moving: the newest command has ended well."""
        self.error = 0.0
        """Largest distance of a joint from the path of the newest command, radians (metres)."""
        self.force = 0.0
        """Largest force from outside that was felt meanwhile, as if it acted on the hand, newtons."""
        self.stopped: Stopped = ""
        """Why the newest command was not carried out to its end."""
        self.reason = ""

    def brake(self) -> None:
        """Has what is under way come to a stand at once; held things stay held."""
        self._asked = True

    def carry_out(self, command: RobotCommand, id: Callable[[], bytes]) -> Iterator[None]:
        """Follows a trajectory, then drives the fingers; lets others in after every piece of it.

        ``id`` gives goals their 16 bytes. Nothing is sent while it is not known where every joint is.
        """
        self._asked, self.error, self.force, self.stopped, self.reason = False, 0.0, 0.0, "", ""
        self._shown.clear()
        unknown, self._stands = not self._stands, False
        try:
            yield from self._know()
            if unknown:
                self._stop_again()
                yield from self._rest()
            if len(command.times):
                yield from self._follow(command, id())
            if command.gripper_width is not None:
                yield from self._grip(command.gripper_width, id())
            self._stands = True
        except _Broken as broken:
            self.stopped, self.reason = broken.stopped, str(broken)

    def show(self, command: RobotCommand) -> None:
        """Publishes a motion as a ghost, after those shown before, for who looks on; nothing moves."""
        points = [
            {"positions": q, "time_from_start": duration(t)}
            for t, q in zip(command.times, command.positions, strict=True)
        ]
        path = Path.trajectory(self._types, self._names, points)
        self._shown.append(self._types.new("moveit_msgs/msg/RobotTrajectory", joint_trajectory=path))
        posture = {"name": self._names, "position": self._joints.positions(self._names)}
        ghost = self._types.new(
            DISPLAY,
            trajectory=self._shown,
            trajectory_start={"joint_state": posture},
        )
        self._ghosts.put(ghost)
        self.sent.append(self._kept(self._ghosts.endpoint.topic, ghost))

    def trouble(self) -> str:
        """Why the joints are not known now; empty where they are."""
        return self._joints.trouble()

    def posture(self) -> Floats:
        """J, of the robot's joints; they must be known."""
        return self._joints.positions(self._names)

    def opening(self) -> float:
        """Metres between the fingers."""
        return self._robot.gripper.width(float(self._joints.positions([self._finger])[0]))

    def time(self) -> float:
        """Seconds, by the robot's clock."""
        return self._joints.stamp_ns(self._names[0]) / 1e9

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._node.close()

    def _know(self) -> Iterator[None]:
        """Waits a little for joint states that are fresh."""
        until = time.monotonic() + self._care.answer
        self._joints.take(0.0)
        self._listen()
        while (why := self._joints.trouble()) and time.monotonic() < until:
            yield
            self._listen()
        if why:
            raise _Broken("fault", why)

    def _follow(self, command: RobotCommand, id: bytes) -> Iterator[None]:
        care, q = self._care, self.posture()
        if command.joint_names != self._robot.joints:
            raise _Broken(
                "fault", f"commanded are {', '.join(command.joint_names)}; {', '.join(self._robot.joints)} move"
            )
        away = np.abs(command.positions[0] - q).max()
        if away > _BESIDE:
            raise _Broken("fault", f"the arm is {away:.2f} rad from where the motion begins: it was moved")
        path = Path.of(command, q, limits=self._robot.velocity, speed=care.speed)
        goal = path.goal(
            self._types, self._names, path=care.path_tolerance, end=care.goal_tolerance, overtime=care.goal_time
        )
        watch = _Watch(path, self._felt(q), care.stuck)

        def check(joints: Sequence[Known]) -> None:
            self._look(watch, joints, command.guard)

        status, result = yield from self._goal(self._arm, FOLLOW, id, goal, check)
        if status != "succeeded" or result.error_code != 0:
            text = result.error_string or _CODES.get(result.error_code, f"error {result.error_code}")
            why: Stopped = "touch" if result.error_code in _HELD_UP else "fault"
            raise _Broken(why, f"{self._controllers.trajectory}: {status}: {text}")
        yield from self._rest()

    def _felt(self, q: Floats) -> Felt | None:
        """None where no efforts are told."""
        measured = self._joints.efforts(self._names)
        if self._efforts is not None and np.isnan(measured).any():
            self.said.append(f"{self._controllers.joint_states}: gives no efforts; no force is felt")
            self._efforts = None
        return None if self._efforts is None else Felt(self._efforts, q, measured)

    def _look(self, watch: _Watch, joints: Sequence[Known], guard: Guard | None) -> None:
        """Takes what is known of the joints; raises where it breaks what must hold."""
        error, force = watch.take(joints[: len(self._names)])
        if not np.isfinite(force):
            raise _Broken("fault", f"{self._controllers.joint_states}: gives no efforts any more")
        self.error, self.force = max(self.error, error), max(self.force, force)
        if guard is not None and (broken := guard.broken(opening=self.opening(), force=force, error=error)):
            raise _Broken(*broken)

    def _grip(self, width: float, id: bytes) -> Iterator[None]:
        """The fingers stall with limited force at what is between them."""
        controllers = self._controllers
        told = self._robot.gripper.finger_position(width) if controllers.gripper_unit == "joint" else width
        if controllers.gripper_type == "GripperCommand":
            command = {"position": told, "max_effort": controllers.gripper_effort}
        else:
            command = {"name": [self._finger], "position": [told], "effort": [controllers.gripper_effort]}
        late = time.monotonic() + self._care.stuck

        def check(_: Sequence[Known]) -> None:
            if time.monotonic() > late:
                raise _Broken("fault", f"{controllers.gripper}: has not ended within {self._care.stuck:g} s")

        status, result = yield from self._goal(self._gripper, self._gripper_type, id, {"command": command}, check)
        # Whoever is not configured to allow stalling calls a grasp aborted.
        if status != "succeeded" and not result.stalled:
            raise _Broken("fault", f"{controllers.gripper}: {status}")
        yield from self._rest()
        position, opening = float(self._joints.positions([self._finger])[0]), self.opening()
        if result.reached_goal and abs(position - width) < _ALIKE and abs(opening - width) > _UNLIKE:
            raise _Broken(
                "fault",
                f"controllers.gripper_unit = {controllers.gripper_unit!r}: the gripper has reached {told:.3f}, but "
                f"{controllers.joint_states} has joint {self._finger!r} at {position:.3f}, which is "
                f"{1e3 * opening:.0f} mm between the fingers where {1e3 * width:.0f} were wanted: one of the two is in "
                "another unit; valid: 'joint', 'opening'",
            )

    def _goal(
        self, client: ActionClient, type: str, id: bytes, fields: dict[str, Any], check: _Check
    ) -> Generator[None, None, tuple[str, Any]]:
        """Has a goal carried out, while ``check`` takes every joint state; returns its status and result. However that
        ends early, the goal is cancelled."""
        if self._asked:
            raise _Broken("stop", "as asked")
        name = client.name
        uuid = {"uuid": list(id)}
        request = self._types.new(
            f"{type}_SendGoal_Request", goal_id=uuid, goal=self._types.new(f"{type}_Goal", **fields)
        )
        self.sent.append(self._kept(f"{name}/_action/send_goal", request))
        try:
            goal = client.send(id, seconds=self._care.answer, **fields)
        except Unanswered as error:
            # An answer that got lost may have been yes.
            raise _Broken("fault", f"{error}{self._cancel(client, id)}") from None
        try:
            while (ended := _ended(goal)) is None:
                yield
                self._attend(check)
        except _Broken as broken:
            raise _Broken(broken.stopped, f"{broken}{self._cancel(client, id)}") from None
        except BaseException:
            self._cancel(client, id)
            raise
        status, result = ended
        response = self._types.new(f"{type}_GetResult_Response", status=STATUSES.index(status), result=result)
        self.heard.append(self._kept(f"{name}/_action/get_result", response))
        return status, result

    def _attend(self, check: _Check) -> None:
        """Looks at what came since the last time; raises where the command is to be broken off."""
        for joints in self._listen():
            check(joints)
        if self._asked:
            raise _Broken("stop", "as asked")
        if why := self._joints.trouble():
            raise _Broken("fault", why)

    def _cancel(self, client: ActionClient, id: bytes) -> str:
        """Has a goal given up and waits until nothing moves; returns what went wrong with that, in words to append."""
        request = self._types.new(f"{CANCEL}_Request", goal_info={"goal_id": {"uuid": list(id)}})
        self.sent.append(self._kept(f"{client.name}/_action/cancel_goal", request))
        self._unstopped = client, id
        try:
            agreed = client.cancel(id, seconds=self._care.answer)
            for _ in self._rest():
                pass
        except Unanswered as error:
            return f"; it could not be told to stop: {error}"
        except _Broken as broken:
            return f"; {broken}"
        if not agreed:
            return "; the controller refuses to give it up"
        self._unstopped = None
        return ""

    def _stop_again(self) -> None:
        """Has what could not be stopped before given up, before anything else moves."""
        if self._unstopped is not None and (why := self._cancel(*self._unstopped)):
            raise _Broken("fault", f"a goal of before may be under way{why}")

    def _rest(self) -> Iterator[None]:
        """Waits until the arm stands."""
        seen: deque[tuple[float, Floats]] = deque()
        until = time.monotonic() + self._care.stuck
        while not seen or seen[-1][0] - seen[0][0] < _SETTLE:
            heard = self._listen()
            if why := self._joints.trouble():
                raise _Broken("fault", why)
            now, q = time.monotonic(), self.posture()
            while seen and np.abs(seen[0][1] - q).max() > _STILL:
                seen.popleft()
            if heard:
                seen.append((now, q))
            if now > until:
                raise _Broken("fault", f"the arm does not come to rest within {self._care.stuck:g} s")
            yield

    def _listen(self) -> list[Sequence[Known]]:
        """What is known of the joints, the robot's and the finger, at every joint state that has come; waits for one
        for a moment."""
        news = self._joints.take(_PIECE)
        topic = self._controllers.joint_states
        self.heard.extend(self._kept(topic, one.message, one.time_ns) for one in news)
        return [one.joints for one in news if one.joints]

    def _kept(self, topic: str, message: Any, time_ns: int = 0) -> Ros2Message:
        data = np.frombuffer(self._types.encode(message), np.uint8)
        return Ros2Message(topic=topic, type=message.__msgtype__, data=data, time_ns=time_ns or time.time_ns())


class _Watch:
    """One motion as its joint states tell of it."""

    def __init__(self, path: Path, felt: Felt | None, stuck: float) -> None:
        self._progress, self._felt, self._stuck = Progress(path), felt, stuck
        self._began = self._moved = time.monotonic()

    def take(self, joints: Sequence[Known]) -> tuple[float, float]:
        """How far the arm is from its path, radians (metres), and the force that it feels, newtons.

        ``joints`` are the robot's. Raises where it makes no progress for too long.
        """
        now, progress = time.monotonic(), self._progress
        before, q = progress.index, np.array([one.position for one in joints])
        error = progress.advance(q, now - self._began)
        if progress.index != before:
            self._moved = now
        elif now - self._moved > self._stuck:
            where = "at the end of its motion" if progress.ended else "on the way"
            raise _Broken("fault", f"the controller stands {where} for {self._stuck:g} s and says nothing")
        if self._felt is None:
            return error, 0.0
        k, seconds = progress.index, max(one.stamp_ns for one in joints) / 1e9
        measured = np.array([one.effort for one in joints])
        return error, self._felt.newtons(q, progress.velocities[k], progress.accelerations[k], measured, seconds)


def _ended(goal: Goal) -> tuple[str, Any] | None:
    """Status and result of a goal; None while it is under way."""
    try:
        return goal.result(0.0)
    except TimeoutError:
        return None
    except Unanswered as error:
        raise _Broken("fault", str(error)) from None
