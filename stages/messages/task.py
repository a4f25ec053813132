"""Demonstrating, planning and acting."""

from typing import Literal

from runner.contract import Command, Message, Struct
from stages.messages.arrays import Pose, Poses
from stages.messages.correction import Arrived
from stages.messages.scene import Assertion, Doubt, SceneGraph

FailedStage = Literal[
    "", "ik", "pick motion", "grasp", "place motion", "release", "slip", "touch", "unknown", "stop", "fault"
]
"""``unknown``: let go of without having felt that it stands. ``slip``, ``touch``, ``fault``: why a motion was broken
off, see :data:`stages.messages.robot.Stopped`."""

STOPPED = "stop"
"""Stands where an outcome or a verdict names the stage that failed: somebody asked to stop."""
STANDS = (STOPPED, "fault")
"""Why an arm stands where it is until it is to recover."""


class Arrangement(Message, frozen=True, kw_only=True):
    """Asks the person (scripted, in simulation) to lay out a scene."""

    kind: Literal["goal", "start"]


class Goal(Message, frozen=True, kw_only=True):
    """A demonstrated scene, remembered by name."""

    name: str
    scene: SceneGraph
    pddl: str
    """The goal as a PDDL problem fragment; pose labels are tied to poses in comments."""
    picture: bytes = b""
    """JPEG of the look at which it was shown, from where goals are kept; empty where nobody keeps it."""


class Task(Message, frozen=True, kw_only=True):
    """Asks the planner to turn ``current`` into ``goal``."""

    goal_name: str
    goal: SceneGraph
    current: SceneGraph
    avoid: tuple[str, ...] = ()
    """Transfers that failed and should not be tried the same way again (``Transfer.key``); one that failed in other
    places, too, more than once."""
    aside: str = ""
    """An object to be put elsewhere first, to see what it hides; nothing else is asked for then."""
    then: tuple[str, ...] = ()
    """What the plan before still had to do, as symbolic actions. Where that still leads to the goal, it is the plan."""


class Transfer(Struct, frozen=True, kw_only=True):
    """A pick and the place that follows it: what the executor does as one."""

    object: str
    source: str
    """What supports the object now (``table`` or an object)."""
    destination: str
    """What supports it afterwards."""
    T_base_targets: Poses
    """Poses of the object that would do, best first."""
    pick: str
    """The symbolic action, for example ``(pick cup table)``."""
    place: str
    faces: bool = False
    """Whether the object has to show the side that the poses say; else poses that differ by a symmetry of its shape
    would do as well."""

    @property
    def key(self) -> str:
        """Names the transfer whatever its poses are, for ``Task.avoid``."""
        return f"{self.object}: {self.source} -> {self.destination}"


class Plan(Message, frozen=True, kw_only=True):
    """The planner's answer: transfers in order, or the reason why there are none."""

    status: Literal["satisfied", "solved", "refused"]
    reason: str
    transfers: tuple[Transfer, ...]
    actions: tuple[str, ...]
    domain_pddl: str
    problem_pddl: str
    expanded: int = 0
    """Search states expanded."""
    at_least: int = 0
    """Transfers that every plan needs, whatever room there is and the hand reaches; 0 where there is no plan."""


class TransferRequest(Message, frozen=True, kw_only=True):
    """Asks the executor for one transfer in the scene as it was last perceived."""

    transfer: Transfer
    scene: SceneGraph
    number: int
    then: tuple[Transfer, ...] = ()
    """What the plan has after it, for an arm that only shows what it would do."""


class Recover(Message, frozen=True, kw_only=True):
    """Asks the executor to bring the arm home from where it was stopped; what it holds goes back where it was."""


class Outcome(Message, frozen=True, kw_only=True):
    """How a transfer ended, as far as the hand feels it: whether it is done the next look says."""

    number: int
    """Of the transfer; 0 where the arm came home after a stop."""
    object: str
    destination: str
    success: bool
    failed_stage: FailedStage
    reason: str
    grasp: str
    """Name of the grasp that was used."""
    attempts: int
    robot_seconds: float
    planning_seconds: float
    T_base_object: Pose | None = None
    """Where the hand let go of the object; None where it did not."""
    held: str = ""
    """What is still in the hand."""


class Verdict(Message, frozen=True, kw_only=True):
    """The demonstrator's last word on a goal: each relation, satisfied or not."""

    goal_name: str
    success: bool
    failed_stage: str
    """Empty for a success, :data:`STOPPED` where somebody asked for the end."""
    reason: str
    satisfied: tuple[Assertion, ...]
    violated: tuple[Assertion, ...]
    looks: int = 0
    """Scenes perceived, plans made and transfers tried on the way to this verdict."""
    plans: int = 0
    transfers: int = 0


class Teach(Command, frozen=True, kw_only=True):
    """Looks, and remembers the scene as the goal of that name."""

    answers = (Goal, Verdict)

    name: str
    """Letters, digits, - and _, at most 100 bytes as UTF-8."""
    ask: bool = False
    """Asks where the look leaves something open."""


class Restore(Command, frozen=True, kw_only=True):
    """Looks, plans and acts until the goal of that name holds or cannot be reached."""

    answers = (Verdict,)

    name: str
    """Of a goal that was taught."""
    ask: bool = False
    """Asks where a look leaves something open, and waits for go before anything moves."""


class Go(Command, frozen=True, kw_only=True):
    """Carries out the plan that waits for it."""


class Pause(Command, frozen=True, kw_only=True):
    """Finishes the transfer that is under way, looks and plans, and then waits for go."""


class Question(Message, frozen=True, kw_only=True):
    """Asks the person about what a look leaves open; nothing moves until it is answered."""

    number: int
    """Counts the questions of a task, from 1."""
    doubt: Doubt


class Answer(Command, frozen=True, kw_only=True):
    """Answers the question that was asked."""

    question: int
    """Its number: what was asked before cannot be answered any more."""
    choice: str
    """One of those that the question offers."""


class Look(Command, frozen=True, kw_only=True):
    """Takes a look, for whoever wants to know what is there now; nothing is remembered."""


class Stop(Command, frozen=True, kw_only=True):
    """Ends what is under way: the robot first puts down what it holds, and begins nothing more."""

    answers = (Verdict,)
    now: bool = False
    """The arm stands at once, where it is; what it holds it goes on holding."""


class Halt(Command, frozen=True, kw_only=True):
    """Stops the arm at once, where it is. What it holds it goes on holding; the answer says what that is."""

    answers = (Outcome, Arrived)


class Arrange(Command, frozen=True, kw_only=True):
    """Lays the objects of the simulated world out, as a person would."""

    kind: Literal["goal", "start"]
    """The scene to be shown, or a disturbed one."""
    draw: int = 0
    """Each number draws another scene of that kind."""


class Move(Command, frozen=True, kw_only=True):
    """Puts an object of the simulated world elsewhere, as a person would."""

    name: str
    x: float
    """Metres in front of the robot's base."""
    y: float
    """Metres to its left."""
