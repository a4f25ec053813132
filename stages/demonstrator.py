"""Goals shown and got back: by its script (shown, disturbed, restored) or as somebody asks for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from itertools import islice
from math import pi
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from runner.contract import Context, Refused, Stage
from stages.geometry.poses import pose
from stages.messages import (
    Answer,
    Arrangement,
    Arrived,
    Asked,
    Assertion,
    Brake,
    Go,
    Goal,
    Kept,
    Look,
    LookRequest,
    Observation,
    Outcome,
    Pause,
    Plan,
    Question,
    Recover,
    Restore,
    RobotState,
    SceneGraph,
    Stop,
    Task,
    Teach,
    Transfer,
    TransferRequest,
    Verdict,
)
from stages.messages.scene import SceneObject
from stages.messages.task import STANDS, STOPPED
from stages.perception.confidence.memory import Memory
from stages.planning.places.hiding import hiders
from stages.planning.places.placements import Scene
from stages.planning.symbolic.pddl import goal_pddl
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import Catalogue
from stages.scene.doubts import SURE, UNSURE, corrected, is_below, open_doubt, which
from stages.scene.facing import shows
from stages.scene.goals import check_name
from stages.scene.goals import without as left_out
from stages.scene.naming import best_exchange, exchanges
from stages.scene.relations import Tolerances, gaps, is_covered
from stages.scene.stance import TIPPED, Stances, is_tipped, standing_of, turned
from stages.scene.virtual import satisfied, without

_EXCHANGES = 200
"""Ways to name equal objects that are compared; where there are more, the one by single objects comes first."""
_WRONG_SIDE = "is not seen to show the side that it should"
_UNKNOWN = "something is there that no object explains"
_SAME_PLACE = 0.05
"""Metres between the middles of what no object explains in two looks up to which it is the same thing."""


class Phase(Enum):
    """What the demonstrator waits for."""

    ARRANGING = "the person's arrangement"
    LOOKING = "a scene graph"
    PLANNING = "a plan"
    TRANSFERRING = "the outcome of a transfer"
    RECOVERING = "the arm to come home"
    ASKING = "an answer"
    READY = "go"
    IDLE = "a command"
    DONE = "nothing more"


@dataclass(frozen=True, slots=True)
class State:
    """Where the episode stands; every handler replaces it as a whole."""

    goals: dict[str, SceneGraph] = field(default_factory=dict[str, SceneGraph])
    """What has been taught, by name. Never changed, only replaced."""
    goal_name: str = ""
    """The goal that is looked at or restored."""
    phase: Phase = Phase.ARRANGING
    purpose: str = "goal"
    """What the current scene is looked at for."""
    repeats: int = 0
    """Times that the current scene was looked at again."""
    views: tuple[int, ...] = (0,)
    """From where it is being looked at, and will be: numbers of :attr:`LookRequest.view`."""
    seen: frozenset[str] = frozenset()
    """Names of what it showed from the views before."""
    looks: int = 0
    plans: int = 0
    replans: int = 0
    transfers: int = 0
    goal: SceneGraph | None = None
    """What is to be restored; None while it is being shown."""
    whole: SceneGraph | None = None
    """The goal as it was shown, while what is restored is the part of it that does without what is missing."""
    lacking: str = ""
    """What is missing of it, in words."""
    scene: SceneGraph | None = None
    """As it was looked at last, completed from memory."""
    first: SceneGraph | None = None
    """The scene in which the restoring began."""
    known: Mapping[str, SceneObject] = field(default_factory=dict[str, SceneObject])
    """Where each object was last seen or placed since the scene was arranged, by name. Never changed, only replaced."""
    remembered: tuple[str, ...] = ()
    """Objects of that scene that the look did not show."""
    unproved: frozenset[str] = frozenset()
    """Objects that were let go of, not felt to stand, and not seen since."""
    transfer: Transfer | None = None
    """Requested, and its effect not seen yet."""
    remainder: tuple[Transfer, ...] = ()
    """What the newest plan has to do beyond that."""
    failures: tuple[str, ...] = ()
    """Key of every transfer that failed or missed its relation, in order."""
    complaint: str = ""
    """Why the newest transfer failed; empty where it reached its relation."""
    missing: str = ""
    """What is looked for by putting things aside, in words."""
    searched: tuple[str, ...] = ()
    """What was put aside, or could not be, since something was found."""
    stuck: tuple[str, ...] = ()
    """What the hand failed to put aside since then: it is tried once more after all else."""
    stopping: bool = False
    """Somebody asked to stop: what is waited for is the last."""
    halted: bool = False
    """The arm stands where it was stopped."""
    astray: str = ""
    """Why the arm did not get to where the camera looks from; empty where it did."""
    ask: bool = False
    """Somebody is there to be asked what a look leaves open."""
    asked: int = 0
    """Questions so far, of all tasks."""
    question: Question | None = None
    shown: tuple[SceneGraph, Observation] | None = None
    """What it was asked about."""
    answers: Mapping[str, str] = field(default_factory=dict[str, str])
    """By key of the doubt. Never changed, only replaced."""
    waits: Literal["", "asked", "paused"] = ""
    """Why the next plan waits for go."""
    plan: Plan | None = None
    """The one that waits."""

    @property
    def taught(self) -> SceneGraph | None:
        """The goal as it was shown; None while it is being shown."""
        return self.whole or self.goal


class Demonstrator(Stage):
    """Remembers a demonstrated scene as the goal and drives the robot until it holds again.

    One :class:`State` and no clock. What a look does not show counts as being where it was last seen or placed, unless
    that place is seen empty. A scene that is new, or lacks something, is looked at from all of the robot's views, from
    home last; what only an earlier look shows is remembered. After each transfer the scene is perceived again and
    planned from again, since targets depend on poses; comparing the new plan with what the old one still had to do says
    whether the plan was kept, repaired or replaced. Every way through ends in exactly one verdict; without the script
    the next command may follow.
    """

    stateful = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """From where to look, and how long to persist."""

        catalogue: Path
        robot: Path = ROBOT
        """Whose views a scene is looked at from."""
        scripted: bool = True
        """Shows a goal, disturbs it and restores it; else only what is called happens."""
        goal_name: str = "breakfast"
        """Of the script."""
        n_objects: int | Literal["auto"] = "auto"
        """Objects that the goal scene must show; ``auto`` (as 0) accepts any number."""
        repeats: int = 2
        """Further looks at a scene in which objects are missing or for which there is no plan."""
        tries: int = 2
        """Failures of one transfer before plans avoid it."""
        max_replans: int = 8
        """Plans that replace, rather than continue, the one before."""
        max_transfers: int = 24

        def __post_init__(self) -> None:
            """Refuses limits that are not counts and names that are no file names."""
            if self.n_objects != "auto" and self.n_objects < 0:
                raise Refused(f"demonstrator.n_objects={self.n_objects}: must be 0 or more, or auto")
            for name, least in (
                ("repeats", 0),
                ("tries", 1),
                ("max_replans", 0),
                ("max_transfers", 1),
            ):
                if getattr(self, name) < least:
                    raise Refused(f"demonstrator.{name}={getattr(self, name)}: must be {least} or more")
            check_name(f"demonstrator.goal_name={self.goal_name!r}", self.goal_name)

    def __init__(self, config: Config) -> None:
        self._config = config
        self._catalogue = Catalogue.shared(config.catalogue)
        self._views = len(read_robot(config.robot).views)
        self._memory = Memory(self._catalogue)
        self._stances = {label: Stances(item) for label, item in self._catalogue.objects.items()}
        self._state = State(goal_name=config.goal_name) if config.scripted else State(phase=Phase.IDLE)

    def on_start(self, ctx: Context) -> Arrangement:
        """Has the goal scene laid out."""
        if self._config.scripted:
            ctx.log(f'the person lays out the goal "{self._config.goal_name}"')
        return Arrangement(kind="goal")

    def on_teach(self, teach: Teach, ctx: Context) -> LookRequest | Recover:
        """Looks at what is to be remembered."""
        check_name(f"name={teach.name!r}", teach.name)
        self._begin(teach.name, None, ask=teach.ask)
        ctx.log(f'looks at the goal "{teach.name}"')
        return self._first_look(f"goal {teach.name}")

    def on_restore(self, restore: Restore, ctx: Context) -> LookRequest | Recover:
        """Looks at what there is to do for a goal."""
        self._begin(restore.name, self._goal(restore.name), ask=restore.ask)
        ctx.log(f'restores the goal "{restore.name}"')
        return self._first_look(f"restore {restore.name}")

    def on_look(self, look: Look, ctx: Context) -> LookRequest | Recover:
        """Looks without a goal."""
        self._begin("", None)
        ctx.log("looks at what is there")
        return self._first_look("look")

    def on_stop(self, stop: Stop, ctx: Context) -> Verdict | Brake | None:
        """Lets what is under way come to its end, at once where that is an arm that moves, and nothing follow it."""
        self._refuse_idle()
        if self._state.phase in (Phase.ASKING, Phase.READY):
            return self._stopped(ctx)
        self._state = replace(self._state, stopping=True, halted=self._state.halted or stop.now)
        ctx.log(f"stops after {self._state.phase.value}")
        return Brake() if stop.now else None

    def on_pause(self, pause: Pause, ctx: Context) -> None:
        """Has the next plan wait."""
        self._refuse_idle()
        self._state = replace(self._state, waits="paused")
        ctx.log("pauses before the next transfer")

    def on_go(self, go: Go, ctx: Context) -> TransferRequest | LookRequest | Task | Verdict | None:
        """Carries out the plan that waits; after a pause, in which people move things, only after another look."""
        state = self._state
        if not state.waits:
            raise Refused("nothing waits for go")
        self._state = replace(state, waits="", plan=None)
        if state.plan is None:
            return None
        return self._proceed(state.plan, ctx) if state.waits == "asked" else self._look(state.purpose)

    def on_answer(
        self, answer: Answer, ctx: Context
    ) -> Iterator[LookRequest | Goal | Arrangement | Task | Verdict | Question]:
        """Goes on with what was answered."""
        state = self._state
        if state.question is None or state.question.number != answer.question:
            now = "nothing is asked now" if state.question is None else f"{state.question.number} is asked now"
            raise Refused(f"question={answer.question}: {now}")
        doubt = state.question.doubt
        if answer.choice not in doubt.choices:
            raise Refused(f"choice={answer.choice!r}: valid: {', '.join(doubt.choices)}")
        ctx.log(f"{doubt.key}: {answer.choice}")
        return self._answered(doubt.key, answer.choice, ctx)

    def on_robot_state(self, robot_state: RobotState, ctx: Context) -> LookRequest | Verdict | None:
        """Looks once a scene is arranged. Robot states that end the executor's motions are not for this stage."""
        if self._state.phase is not Phase.ARRANGING:
            return None
        return self._stopped(ctx) if self._state.stopping else self._look(self._state.purpose)

    def on_scene_graph(
        self, scene_graph: SceneGraph, observation: Observation, ctx: Context
    ) -> Iterator[LookRequest | Goal | Arrangement | Task | Verdict | Question]:
        """Remembers the goal, or compares the scene with it and asks for a plan where they differ."""
        if self._state.phase is not Phase.LOOKING:
            return
        if self._state.stopping:
            self._state = replace(self._state, looks=self._state.looks + 1)
            yield self._stopped(ctx)
            return
        if not self._state.goal_name:
            self._state = replace(self._state, phase=Phase.IDLE)
            return
        if observation.unusable:
            self._state = replace(self._state, looks=self._state.looks + 1)
            yield self._look_again("perception", observation.unusable, ctx, blind=True)
            return
        yield from self._consider(scene_graph, observation, ctx)

    def _answered(
        self, key: str, choice: str, ctx: Context
    ) -> Iterator[LookRequest | Goal | Arrangement | Task | Verdict | Question]:
        state = self._state
        assert state.shown is not None  # A question is about a scene.
        self._state = replace(state, question=None, shown=None)
        if choice == "again":
            yield self._look(state.purpose)
        else:
            self._state = replace(self._state, answers={**state.answers, key: choice})
            yield from self._consider(*state.shown, ctx)

    def _consider(
        self, scene_graph: SceneGraph, observation: Observation, ctx: Context
    ) -> Iterator[LookRequest | Goal | Arrangement | Task | Verdict | Question]:
        """Asks about what the scene leaves open, where somebody is there; else acts on the scene."""
        state, shown = self._state, (scene_graph, observation)
        scene_graph = corrected(scene_graph, state.answers, self._memory.related)
        doubt = open_doubt(scene_graph, state.goal, state.answers) if state.ask else None
        if doubt is not None:
            question = Question(number=state.asked + 1, doubt=doubt)
            choices = "|".join(doubt.choices)
            ctx.log(f"asks: {doubt.key}; runner call demonstrator answer question={question.number} choice={choices}")
            self._state = replace(state, phase=Phase.ASKING, question=question, shown=shown, asked=question.number)
            yield question
            return
        scene_graph = self._memory.named(scene_graph, state.known, observation, state.seen)
        goal = state.taught
        scene = self._memory.complete(scene_graph, state.known, observation, _names(goal) if goal else ())
        seen, ahead, unproved = state.seen | _names(scene_graph), state.views[1:], state.unproved
        if state.goal is not None and (not state.known or _spares(scene, state.goal)):
            names = self._exchanged(scene, state.goal)
            seen, unproved = (frozenset(names.get(name, name) for name in some) for some in (seen, unproved))
            scene = self._memory.renamed(scene, [names[item.name] for item in scene.objects])
        self._state = replace(
            self._state,
            known={item.name: item for item in scene.objects if not self._is_unlikely(item)},
            looks=self._state.looks + 1,
            seen=seen,
            unproved=unproved - seen,
        )
        if ahead:
            self._state = replace(self._state, views=ahead)
            yield self._look_request()
            return
        self._state = replace(
            self._state,
            scene=scene,
            first=self._state.first or (scene if self._state.goal is not None else None),
            remembered=tuple(sorted(_names(scene) - seen)),
        )
        whole = self._state.whole
        if whole is not None and _names(whole) <= _names(scene):
            self._state = replace(self._state, goal=whole, whole=None, lacking="")
        missing = self._missing(scene)
        if missing:
            yield self._look_for(missing, scene, ctx)
        elif self._state.goal is None and (doubtful := self._doubtful(scene, SURE)):
            yield self._look_again("perception", f"in doubt: {', '.join(doubtful)}", ctx)
        elif self._state.goal is None and scene.unknown and self._may_see_more() and not self._state.ask:
            yield self._look_again("perception", _UNKNOWN, ctx)
        elif self._state.goal is None and scene.contested and self._may_see_more():
            yield self._look_again("perception", _contest(scene), ctx)
        elif self._state.goal is None:
            yield from self._remember(scene, ctx)
        else:
            yield self._compare(self._state.goal, scene, ctx)

    def on_plan(self, plan: Plan, ctx: Context) -> TransferRequest | LookRequest | Task | Verdict | None:
        """Starts the plan's first transfer, or gives up where there is none."""
        if self._state.phase is not Phase.PLANNING:
            return None
        self._state = replace(self._state, plans=self._state.plans + 1)
        if self._state.stopping:
            return self._stopped(ctx)
        if plan.status != "solved":
            return self._without_plan(plan, ctx)
        if self._state.missing:
            # What was to be put aside, or what is in the way of that: each once.
            *before, _ = self._state.searched
            moved = plan.transfers[0].object
            if moved in before:
                again = msgspec.structs.replace(plan, reason=f"{moved} was put aside before")
                return self._without_plan(again, ctx)
            self._state = replace(self._state, searched=(*before, moved))
        return self._wait(plan, ctx) if self._state.waits else self._proceed(plan, ctx)

    def _without_plan(self, plan: Plan, ctx: Context) -> LookRequest | Task | Verdict:
        """Looks again, or behind something else."""
        if self._state.missing and self._state.scene is not None:
            ctx.log(plan.reason, level="warning")
            return self._look_for(self._state.missing, self._state.scene, ctx)
        if plan.status == "satisfied":
            return self._look_again("planner", f"the planner finds nothing to do; {self._violated()}", ctx)
        if self._state.complaint:
            return self._look_again("executor", f"{self._state.complaint}; no other way: {plan.reason}", ctx)
        return self._look_again("planner", plan.reason, ctx)

    def on_outcome(self, outcome: Outcome, ctx: Context) -> LookRequest | Verdict | None:
        """Looks at what the transfer did, whatever the hand has felt."""
        stands = outcome.failed_stage in STANDS or outcome.held
        if stands and self._state.phase in (Phase.TRANSFERRING, Phase.RECOVERING):
            return self._stands(outcome.failed_stage, outcome.reason, ctx)
        if self._state.phase is Phase.RECOVERING:
            return self._recovered(outcome, ctx)
        if self._state.phase is not Phase.TRANSFERRING or outcome.number != self._state.transfers:
            return None
        complaint = "" if outcome.success else f"{outcome.failed_stage}: {outcome.reason}"
        how = "felt to stand, to be seen" if outcome.success else f"failed at {complaint}"
        ctx.log(
            f"transfer {outcome.number}, {outcome.object} to {outcome.destination}: {how}",
            level="info" if outcome.success else "warning",
        )
        if self._state.stopping:
            return self._stopped(ctx)
        unfelt = {outcome.object} if outcome.T_base_object is not None and not outcome.success else set[str]()
        unproved = self._state.unproved - {outcome.object} | unfelt
        known = self._known_after(outcome)
        self._state = replace(self._state, complaint=complaint, repeats=0, known=known, unproved=unproved)
        if self._state.missing and not outcome.success and outcome.object not in self._state.stuck:
            searched = tuple(name for name in self._state.searched if name != outcome.object)
            self._state = replace(self._state, searched=searched, stuck=(*self._state.stuck, outcome.object))
        return self._look(f"after transfer {outcome.number}")

    def on_arrived(self, arrived: Arrived, ctx: Context) -> Verdict | None:
        """The arm shows itself and brings the camera to where it looks from; where it is stopped or fails itself, there
        is no look."""
        self._state = replace(self._state, astray="" if arrived.success else arrived.reason)
        if arrived.stopped not in STANDS or self._state.phase is not Phase.LOOKING:
            return None
        return self._stands(arrived.stopped, arrived.reason, ctx)

    def _stands(self, why: str, reason: str, ctx: Context) -> Verdict:
        """The end of a task whose arm stands where it is."""
        self._state = replace(self._state, halted=True)
        return self._conclude(STOPPED if why == STOPPED else "executor", reason, ctx)

    def _recovered(self, outcome: Outcome, ctx: Context) -> LookRequest | Verdict:
        """The arm is at home again, or not."""
        if not outcome.success:
            return self._fail("executor", outcome.reason, ctx)
        if self._state.stopping:
            return self._stopped(ctx)
        self._state = replace(self._state, halted=False)
        return self._look(self._state.purpose)

    def _goal(self, name: str) -> SceneGraph:
        goals = self._state.goals
        if name not in goals:
            raise Refused(f"name={name!r}: no such goal; valid: {', '.join(goals) or 'none, teach one first'}")
        if not goals[name].objects:
            raise Refused(f"name={name!r}: names no object; teach it again, or restore another one")
        return goals[name]

    def _refuse_idle(self) -> None:
        if self._state.phase in (Phase.IDLE, Phase.DONE):
            raise Refused("nothing is under way")

    def _begin(self, name: str, goal: SceneGraph | None, *, ask: bool = False) -> None:
        """Starts from anew with a goal, or with one that is yet to be seen."""
        if self._state.phase is not Phase.IDLE:
            raise Refused(f"busy: waits for {self._state.phase.value}; ask again after the verdict")
        waits = "asked" if ask and goal is not None else ""
        self._state = State(
            goals=self._state.goals,
            goal_name=name,
            goal=goal,
            halted=self._state.halted,
            astray=self._state.astray,
            ask=ask,
            asked=self._state.asked,
            waits=waits,
        )

    def _first_look(self, purpose: str) -> LookRequest | Recover:
        """Looks, once the arm is out of the way."""
        if not self._state.halted:
            return self._look(purpose)
        self._state = replace(self._state, phase=Phase.RECOVERING, purpose=purpose)
        return Recover()

    def _look_for(self, missing: str, scene: SceneGraph, ctx: Context) -> LookRequest | Task | Verdict:
        """One more look; after that, what may hide what is missing is put aside."""
        state = self._state
        if state.goal is None or state.repeats == 0 or state.transfers == self._config.max_transfers:
            return self._look_again("perception", missing, ctx)
        hidden = [name for name in self._hiders(scene, state.goal) if name not in state.searched]
        hidden.sort(key=state.stuck.__contains__)
        if not hidden:
            return self._look_again("perception", missing, ctx)
        ctx.log(f"{missing}; looks behind and under {hidden[0]}")
        self._state = replace(
            state, phase=Phase.PLANNING, searched=(*state.searched, hidden[0]), transfer=None, missing=missing
        )
        return Task(goal_name=state.goal_name, goal=state.goal, current=scene, aside=hidden[0])

    def _hiders(self, scene: SceneGraph, goal: SceneGraph) -> list[str]:
        missing = [self._stances[item.label] for item in goal.objects if item.name not in _names(scene)]
        movable = {item.name for item in scene.objects if self._catalogue[item.label].grasps}
        return hiders(missing, Scene.of(scene, self._stances), movable)

    def _look(self, purpose: str) -> LookRequest:
        """From home; for a goal first from elsewhere, where nothing is known of the scene or it is looked at again."""
        around = self._state.goal_name and (self._state.repeats or not self._state.known)
        views = (*range(1, self._views + 1), 0) if around else (0,)
        self._state = replace(self._state, phase=Phase.LOOKING, purpose=purpose, views=views, seen=frozenset())
        return self._look_request()

    def _look_request(self) -> LookRequest:
        state = self._state
        again = f", look {state.repeats + 1}" if state.repeats else ""
        where = f", from view {state.views[0]}" if state.views[0] else ""
        return LookRequest(purpose=state.purpose + again + where, view=state.views[0])

    def _look_again(self, stage: str, why: str, ctx: Context, *, blind: bool = False) -> LookRequest | Task | Verdict:
        """One more look at the same scene (its noise is new), or the verdict once these are used up; ``blind`` if the
        last one showed nothing, by which the rest could be restored."""
        if not self._may_see_more():
            why = f"{why} ({self._state.repeats + 1} looks at scene '{self._state.purpose}')"
            missing = stage == "perception" and self._state.goal is not None and not blind
            return self._do_without(why, ctx) if missing else self._fail(stage, why, ctx)
        self._state = replace(self._state, repeats=self._state.repeats + 1)
        ctx.log(f"{why}; looking again", level="warning")
        return self._look(self._state.purpose)

    def _do_without(self, why: str, ctx: Context) -> LookRequest | Task | Verdict:
        """Restores what the goal says of everything else; what is missing is named in the end."""
        goal, scene = self._state.goal, self._state.scene
        assert goal is not None and scene is not None
        rest = without(goal, _names(goal) - _names(scene))
        if not rest.objects:
            return self._fail("perception", why, ctx)
        ctx.log(f"{why}; restores the rest", level="warning")
        self._state = replace(self._state, whole=self._state.whole or goal, goal=rest, lacking=why)
        return self._compare(rest, scene, ctx)

    def _known_after(self, outcome: Outcome) -> Mapping[str, SceneObject]:
        """Where objects are known to be once a transfer has ended: what was let go of is where that was."""
        known = self._state.known
        if outcome.T_base_object is None or outcome.object not in known:
            return known
        placed = msgspec.structs.replace(known[outcome.object], T_base_object=outcome.T_base_object)
        return {**known, outcome.object: placed}

    def _exchanged(self, scene: SceneGraph, goal: SceneGraph) -> dict[str, str]:
        """The names of equal objects (old: new) with which most of the goal holds already; which of them is which is no
        matter, unless somebody is there who is asked."""
        labels, names = [item.label for item in scene.objects], [item.name for item in scene.objects]
        ways = [names]
        if not (self._state.ask and which(scene, goal)):
            wanted = {item.name: item.label for item in goal.objects}
            first = list(islice(exchanges(labels, names, wanted), _EXCHANGES + 1))
            if len(first) > _EXCHANGES:
                ways.append(best_exchange(labels, names, wanted, partial(self._worth, scene, goal)))
            ways += first[:_EXCHANGES]
        held = [len(satisfied(goal, self._memory.renamed(scene, way), self._catalogue)[0]) for way in ways]
        return dict(zip(names, ways[held.index(max(held))], strict=True))

    def _worth(self, scene: SceneGraph, goal: SceneGraph, i: int, name: str) -> float:
        """How many relations of the goal about that name hold if the scene's object ``i`` has it; of equal numbers the
        one nearer to where the goal shows it is worth more."""
        names = [item.name for item in scene.objects]
        exchanged = [names[i] if other == name else other for other in names]
        exchanged[i] = name
        held, _ = satisfied(goal, self._memory.renamed(scene, exchanged), self._catalogue)
        about = {name, *(item.name for item in goal.virtual_objects if name in (item.parent, item.child))}
        shown = [item.T_base_object[:3, 3] for item in goal.objects if item.name == name]
        near = [1 / (1 + np.linalg.norm(place - scene.objects[i].T_base_object[:3, 3])) for place in shown]
        return sum(not about.isdisjoint(item.arguments) for item in held) + float(sum(near)) / (len(names) + 1)

    def _missing(self, scene: SceneGraph) -> str:
        """What the scene lacks that it must show, in words; empty where it is complete."""
        if self._state.goal is None:
            if self._state.astray:
                return f"the camera is not where it looks from: {self._state.astray}"
            wanted = 1 if self._config.n_objects == "auto" else max(1, self._config.n_objects)
            if len(scene.objects) < wanted:
                return f"{len(scene.objects)} of {wanted} objects seen"
            standing = standing_of(scene.objects, self._stances, scene.T_base_table)
            hanging = gaps(standing, scene.assertions, Tolerances())
            return f"not seen: what carries {', '.join(hanging)}" if hanging else ""
        names = _names(self._state.goal) - _names(scene)
        return f"not seen: {', '.join(sorted(names))}" if names else ""

    def _is_unlikely(self, item: SceneObject) -> bool:
        """Whether an object that the goal does not name is less likely there than not: no reason to remember it."""
        goal = self._state.taught
        return is_below(item, UNSURE) and goal is not None and item.name not in _names(goal)

    def _doubtful(self, scene: SceneGraph, least: float) -> list[str]:
        """Objects whose pose is less probable than that, while there is a look left to see them better."""
        return [item.name for item in scene.objects if is_below(item, least)] if self._may_see_more() else []

    def _may_see_more(self) -> bool:
        """Whether there is a look left at the same scene."""
        return self._state.repeats < self._config.repeats

    def _remember(self, scene: SceneGraph, ctx: Context) -> Iterator[Goal | Arrangement]:
        """What one look took to be there, in doubt, and those after it did not show is no part of the goal."""
        there = [
            item for item in scene.objects if item.name not in self._state.remembered or not is_below(item, UNSURE)
        ]
        scene = scene if len(there) == len(scene.objects) else self._memory.related(scene, there)
        name, goals = self._state.goal_name, {**self._state.goals, self._state.goal_name: scene}
        unsure = [
            f"{item.name} ({100 * (item.probability or 0):.0f} %)" for item in scene.objects if is_below(item, SURE)
        ]
        unsure += [_UNKNOWN] if scene.unknown else []
        unsure += [_contest(scene)] if scene.contested else []
        if unsure:
            looks = self._state.repeats + 1
            ctx.log(
                f"still in doubt after {looks} looks, remembered all the same: {', '.join(unsure)}", level="warning"
            )
        ctx.log(f'goal "{name}" remembered: {len(scene.objects)} objects, {len(scene.assertions)} assertions')
        yield Goal(name=name, scene=scene, pddl=goal_pddl(name, scene))
        self._state = replace(self._state, goals=goals, goal=scene, phase=Phase.IDLE, repeats=0)
        if self._config.scripted:
            self._state = replace(self._state, phase=Phase.ARRANGING, purpose="start", known={}, scene=None)
            yield Arrangement(kind="start")

    def _compare(self, goal: SceneGraph, scene: SceneGraph, ctx: Context) -> LookRequest | Task | Verdict:
        """Checks the transfer that led here, then the goal; asks for a plan where relations are violated.

        What was turned in vain as often as is tried need not show a side any more, until the verdict.
        """
        held, violated = satisfied(goal, scene, self._catalogue)
        self._check_transfer(scene, violated, ctx)
        self._state = replace(self._state, missing="", searched=(), stuck=())
        from_memory = f"; remembered, not seen: {', '.join(self._state.remembered)}" if self._state.remembered else ""
        count = f"{len(held)} of {len(held) + len(violated)} goal relations hold"
        ctx.log(f"scene '{self._state.purpose}': {count}{from_memory}")
        in_vain = {key.partition(":")[0] for key in self._avoided()}
        wrong = next((item for item in violated if item.predicate == "faces" and item.arguments[0] in in_vain), None)
        if wrong is not None:
            lacking = "; ".join(filter(None, (self._state.lacking, f"{wrong.arguments[0]} {_WRONG_SIDE}")))
            rest = left_out(goal, str(wrong))
            self._state = replace(self._state, whole=self._state.whole or goal, goal=rest, lacking=lacking)
            return self._compare(rest, scene, ctx)
        if not violated:
            return self._claim(goal, from_memory, ctx)
        if self._state.transfers == self._config.max_transfers:
            why = self._state.complaint or f"{violated[0]} does not hold"
            return self._fail("executor", f"{self._state.transfers} transfers were not enough; {why}", ctx)
        self._state = replace(self._state, phase=Phase.PLANNING)
        ahead = () if self._state.complaint else self._state.remainder
        then = tuple(action for transfer in ahead for action in (transfer.pick, transfer.place))
        return Task(goal_name=self._state.goal_name, goal=goal, current=scene, avoid=self._avoided(), then=then)

    def _claim(self, goal: SceneGraph, from_memory: str, ctx: Context) -> LookRequest | Task | Verdict:
        """The verdict where every relation of the goal holds, unless that is yet to be proved."""
        state = self._state
        if state.lacking:
            return self._fail("perception", f"{state.lacking}; every other relation of the goal holds", ctx)
        if why := self._unproved(goal):
            return self._look_again("perception", why, ctx)
        if unsure := _doubtful_parents(goal):
            why = f"{unsure[0]} was in doubt when the goal was taught, and with it what belongs beside it"
            return self._conclude("perception", f"every relation of the goal holds{from_memory}, yet {why}", ctx)
        return self._conclude("", f"every relation of the goal holds{from_memory}", ctx)

    def _unproved(self, goal: SceneGraph) -> str:
        """What another look must show before the goal counts as restored, in words; empty where that is nothing."""
        state = self._state
        if hidden := state.unproved.intersection(state.remembered):
            return f"let go of, neither felt to stand nor seen since: {', '.join(sorted(hidden))}"
        if doubtful := self._unsettled(goal):
            return f"in doubt: {', '.join(doubtful)}"
        if covered := self._covered(goal):
            return f"something unknown stands on {', '.join(covered)}, which the goal wants clear"
        if not state.ask and self._misses_unknown(goal):
            return "what stood there and no object explained when the goal was taught is not seen there now"
        return ""

    def _unsettled(self, goal: SceneGraph) -> list[str]:
        """Objects of the goal that are less likely as they are taken to be than not, and of which nobody was asked."""
        scene, names = self._state.scene, _names(goal)
        assert scene is not None
        unsure = [item.name for item in scene.objects if item.name in names and is_below(item, UNSURE)]
        return [name for name in unsure if not any(key.startswith(f"stance {name} ") for key in self._state.answers)]

    def _covered(self, goal: SceneGraph) -> list[str]:
        """What is seen, clear in the goal and has something on it that no object explains, unless it had when the goal
        was taught."""
        scene = self._state.scene
        assert scene is not None
        clear = {item.arguments[0] for item in goal.assertions if item.predicate == "clear"}
        now, then = (
            {
                item.name
                for item in standing_of(one.objects, self._stances, one.T_base_table)
                if item.name in clear and is_covered(item, one.unknown, Tolerances())
            }
            for one in (scene, goal)
        )
        return sorted(now - then - {*self._state.remembered})

    def _misses_unknown(self, goal: SceneGraph) -> bool:
        """Whether something that no object explained when the goal was taught stands elsewhere now, or was part of one
        of the objects: it may have been one that the goal should name."""
        assert self._state.scene is not None
        now, then = (
            [(one.T_base_table @ (*region.centre_table, 1.0))[:3] for region in one.unknown]
            for one in (self._state.scene, goal)
        )
        return any(all(np.linalg.norm(here - there) > _SAME_PLACE for here in now) for there in then)

    def _check_transfer(self, scene: SceneGraph, violated: Sequence[Assertion], ctx: Context) -> None:
        """Compares the scene with what the newest transfer promised; one that failed stays in the plan.

        Done is what was felt to stand and is then seen there; what the hand did not feel the look decides.
        """
        state = self._state
        if state.transfer is None:
            return
        transfer, complaint = state.transfer, state.complaint
        seen = transfer.object not in state.remembered
        if complaint.startswith("unknown") and seen and _reached(transfer, scene):
            complaint = ""
        if not complaint and not _reached(transfer, scene):
            complaint = f"release: {transfer.object} is not seen on or in {transfer.destination}"
        actions = transfer.place.split()
        beside = [one for one in violated if one.predicate == "in" and one.arguments[0] in actions]
        if not complaint and any(one.arguments[1] == transfer.object for one in beside):
            complaint = f"release: {beside[0]} does not hold"
        now = next((item for item in scene.objects if item.name == transfer.object), None)
        wanted = transfer.T_base_targets[0]
        if not complaint and now and is_tipped(self._catalogue[now.label], now.T_base_object, wanted):
            complaint = f"release: {transfer.object} does not stand as it should"
        if not complaint and transfer.faces and not (now and shows(now, wanted)):
            complaint = f"release: {transfer.object} {_WRONG_SIDE}"
        if not complaint:
            done = "done" if seen else "unknown: felt to stand, hidden from here"
            ctx.log(f"transfer {state.transfers}, {transfer.object} to {transfer.destination}: {done}")
            state = replace(state, failures=self._forgiven(transfer.object))
        if complaint:
            # What slips from the hand is tried again: nothing is wrong with where it was to go.
            failures = state.failures if complaint.startswith("slip") else (*state.failures, transfer.key)
            state = replace(state, remainder=(transfer, *state.remainder), failures=failures)
        self._state = replace(state, transfer=None, complaint=complaint)

    def _forgiven(self, moved: str) -> tuple[str, ...]:
        """The failures once an object stands elsewhere: from there it goes to other places, and is not put aside."""
        before = self._state.failures
        return tuple(
            key
            for k, key in enumerate(before)
            if key.partition(":")[0] != moved or before[:k].count(key) < self._config.tries
        )

    def _avoided(self) -> tuple[str, ...]:
        counts = Counter(self._state.failures)
        return tuple(sorted(key for key in counts for _ in range(counts[key] // self._config.tries)))

    def _wait(self, plan: Plan, ctx: Context) -> None:
        self._state = replace(self._state, phase=Phase.READY, plan=plan)
        ctx.log(f"waits for go: {', '.join(transfer.key for transfer in plan.transfers)}")

    def _proceed(self, plan: Plan, ctx: Context) -> TransferRequest | LookRequest | Task | Verdict:
        """Requests the first transfer of a solved plan, unless plans have been replaced too often; what is in doubt is
        looked at a second time before it is moved."""
        state = self._state
        assert state.scene is not None  # A plan answers a task, and a task holds a scene.
        moved = plan.transfers[0].object
        if state.repeats == 0 and not state.missing and moved in self._doubtful(state.scene, UNSURE):
            return self._look_again("perception", f"in doubt before it is moved: {moved}", ctx)
        change = "new" if state.plans == 1 or state.missing else change_of_plan(state.remainder, plan.transfers)
        steps = ", ".join(f"{transfer.object} to {transfer.destination}" for transfer in plan.transfers)
        ctx.log(f"plan {state.plans} ({change}): {steps}")
        replans = state.replans + (change == "replaced")
        if replans > self._config.max_replans:
            return self._fail("planner", f"the plan was replaced {replans} times; {self._violated()}", ctx)
        first, *rest = plan.transfers
        number = state.transfers + 1
        self._state = replace(
            state, phase=Phase.TRANSFERRING, transfer=first, remainder=tuple(rest), replans=replans, transfers=number
        )
        return TransferRequest(transfer=first, scene=state.scene, number=number, then=tuple(rest))

    def _fail(self, stage: str, reason: str, ctx: Context) -> Verdict:
        ctx.log(f"giving up: {reason}", level="error")
        return self._conclude(stage, reason, ctx)

    def _stopped(self, ctx: Context) -> Verdict:
        ctx.log("stopped, as asked")
        return self._conclude(STOPPED, "stopped, as asked", ctx)

    def _conclude(self, failed_stage: str, reason: str, ctx: Context) -> Verdict:
        state = self._state
        held: tuple[Assertion, ...] = ()
        violated: tuple[Assertion, ...] = ()
        goal = state.taught
        if goal is not None and state.scene is not None:
            held, violated = satisfied(goal, state.scene, self._catalogue)
            covered = {Assertion(predicate="clear", arguments=(name,)) for name in self._covered(goal)}
            violated = (*violated, *(item for item in held if item in covered))
            held = tuple(item for item in held if item not in covered)
        if state.lacking and state.lacking not in reason:
            reason = f"{reason}; {state.lacking}"
        if fallen := self._fallen():
            reason = f"{reason}; knocked over: {', '.join(fallen)}"
        if gone := self._gone():
            reason = f"{reason}; not seen any more: {', '.join(gone)}"
        phase = Phase.DONE if self._config.scripted else Phase.IDLE
        self._state = replace(state, phase=phase, question=None, shown=None, waits="", plan=None)
        return Verdict(
            goal_name=state.goal_name,
            success=not failed_stage,
            failed_stage=failed_stage,
            reason=reason,
            satisfied=held,
            violated=violated,
            looks=state.looks,
            plans=state.plans,
            transfers=state.transfers,
        )

    def _violated(self) -> str:
        """The first relation of the goal that does not hold, in words."""
        state = self._state
        assert state.goal is not None and state.scene is not None  # A plan answers a task, and a task holds both.
        return f"{satisfied(state.goal, state.scene, self._catalogue)[1][0]} does not hold"

    def _gone(self) -> list[str]:
        """What was there at the start, is in no goal, and is seen nowhere now."""
        state = self._state
        goal = state.taught
        if state.scene is None or state.first is None or goal is None:
            return []
        known = _names(state.scene) | _names(goal)
        return [item.name for item in state.first.objects if item.name not in known and not is_below(item, UNSURE)]

    def _fallen(self) -> list[str]:
        """What lies and stands neither as at the start nor as in the goal, or of what was not seen then, as such things
        stand; upside down nothing falls."""
        state = self._state
        if state.scene is None or state.first is None or state.goal is None:
            return []
        before = [{item.name: item.T_base_object for item in one.objects} for one in (state.first, state.goal)]

        def lies(item: SceneObject) -> bool:
            entry = self._catalogue[item.label]
            usual = pose(entry.resting[0], np.zeros(3))
            stood = [poses[item.name] for poses in before if item.name in poses] or [usual]
            return all(TIPPED < turned(entry, item.T_base_object, T) < pi - TIPPED for T in stood)

        return [item.name for item in state.scene.objects if lies(item)]


class KeepingDemonstrator(Demonstrator):
    """Knows the goals that are on disk, too."""

    def on_kept(self, kept: Kept) -> None:
        """Goals were read, or changed; one that is being restored stays as it is."""
        self._state = replace(self._state, goals={goal.name: goal.scene for goal in kept.goals})


class AskedDemonstrator(KeepingDemonstrator):
    """Does what a device is asked from outside as well as what is called."""

    def on_asked(self, asked: Asked, ctx: Context) -> LookRequest | Recover | Verdict:
        """Teaches or restores; what cannot be done is a verdict, for somebody waits for one."""
        try:
            if asked.kind == "teach":
                return self.on_teach(Teach(name=asked.name), ctx)
            return self.on_restore(Restore(name=asked.name), ctx)
        except Refused as refusal:
            return Verdict(
                goal_name=asked.name,
                success=False,
                failed_stage="demonstrator",
                reason=str(refusal),
                satisfied=(),
                violated=(),
            )


def _names(scene: SceneGraph) -> set[str]:
    return {item.name for item in scene.objects}


def _contest(scene: SceneGraph) -> str:
    return f"the detector also sees {', '.join(scene.contested)}"


def _doubtful_parents(goal: SceneGraph) -> list[str]:
    """Objects in doubt with which places of others turn."""
    parents = {item.parent for item in goal.virtual_objects}
    return [item.name for item in goal.objects if item.name in parents and is_below(item, SURE)]


def _spares(scene: SceneGraph, goal: SceneGraph) -> bool:
    """Whether the goal lacks an object while there is an equal one that it does not name."""
    lost = {item.label for item in goal.objects if item.name not in _names(scene)}
    return any(item.label in lost and item.name not in _names(goal) for item in scene.objects)


def change_of_plan(expected: Sequence[Transfer], planned: Sequence[Transfer]) -> str:
    """How a new plan relates to what the one before still had to do: ``kept``, ``repaired`` or ``replaced``.

    Repaired means that transfers were only inserted or only left out.
    """
    before, after = [item.key for item in expected], [item.key for item in planned]
    if before == after:
        return "kept"
    return "repaired" if _subsequence(before, after) or _subsequence(after, before) else "replaced"


def _subsequence(part: Sequence[str], whole: Sequence[str]) -> bool:
    rest = iter(whole)
    return all(item in rest for item in part)


def _reached(transfer: Transfer, scene: SceneGraph) -> bool:
    arguments = (transfer.object, transfer.destination)
    return any(item.predicate in ("on", "in") and item.arguments == arguments for item in scene.assertions)
