"""Follows a run and tells what was seen, what goes on, how it ended and what can be done."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any, Literal

import msgspec

from runner.contract import Message, Refused
from runner.page.story import (
    Action,
    Arrow,
    Ask,
    Card,
    Doing,
    Heard,
    Language,
    Map,
    Notice,
    Photo,
    Place,
    Question,
    Statement,
    Tie,
    Told,
    View,
)
from stages.geometry.poses import inverse
from stages.messages import (
    Answer,
    Arrange,
    Arrangement,
    Frame,
    Go,
    Goal,
    Kept,
    Look,
    LookRequest,
    Move,
    ObjectPose,
    Outcome,
    Pause,
    Plan,
    Recover,
    Restore,
    SceneEstimate,
    SceneGraph,
    Stop,
    Task,
    Teach,
    Transfer,
    TransferRequest,
    Verdict,
)
from stages.messages.correction import CAMERAS_WAY, OWN_ARM
from stages.messages.scene import SceneObject
from stages.messages.task import STOPPED
from stages.messages.task import Question as AskedQuestion
from stages.scene.catalogue import Catalogue
from stages.scene.doubts import meant
from stages.scene.goals import GoalFolder
from stages.scene.naming import region_name
from stages.scene.text import support
from stages.story import reasons
from stages.story.cards import GOALS, NAME, Remembered, add, card
from stages.story.outlines import footprint, ground, how_sure, outlines, pixel, surety
from stages.story.words import Words, words_of

DEMONSTRATOR, WORLD, CORRECTOR = "demonstrator", "world", "corrector"
"""Stages that take commands, as our graphs call them."""
STEP_SECONDS = 20.0
"""What a transfer is expected to take, before one was seen."""
SHOWN_FAULTS = 4
"""Relations that do not hold, of a goal that was not reached."""
Phase = Literal["look", "show", "turn", "recognise", "teach", "restore", "check", "plan", "move"]


@dataclass(frozen=True, slots=True)
class Job:
    """What the robot is doing for somebody."""

    name: str
    """Of the goal; empty for a look."""
    began_ns: int
    phase: Phase = "look"
    done: int = 0
    """Transfers that have ended."""
    transfers: tuple[Transfer, ...] = ()
    """Those and what the newest plan adds."""
    holders: frozenset[str] = frozenset()
    """Objects that things are put into rather than onto."""
    stopping: bool = False
    question: AskedQuestion | None = None
    """Waits for an answer."""
    answers: Mapping[str, str] = field(default_factory=dict[str, str])
    """What was answered, by key of the doubt. Never changed, only replaced."""
    asks: bool = False
    """The first plan is to wait for go."""
    waits: bool = False
    """The plan waits for go."""
    pausing: bool = False
    """The next plan is to wait for go."""
    step_ns: int = 0
    """When the newest transfer began; 0 where somebody was waited for since."""


class Story:
    """Remembers the newest picture and scene, all goals, and what is under way."""

    hears: tuple[type[Message], ...] = (
        *(Teach, Restore, Look, Stop, Arrange, Arrangement, Move, Kept),
        *(LookRequest, Recover, Frame, SceneEstimate, SceneGraph),
        *(Goal, Task, Plan, TransferRequest, Outcome, Verdict, AskedQuestion, Answer, Go, Pause),
    )

    def __init__(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        """Raises :class:`runner.contract.Refused` where no stage names a catalogue."""
        paths = [config["catalogue"] for config in configs.values() if "catalogue" in config]
        if not paths:
            raise Refused(f"story: none of the stages {', '.join(configs)} has a setting `catalogue`; objects need one")
        self._catalogue = Catalogue.load(Path(paths[0]))
        self._commanded = DEMONSTRATOR in configs and not configs[DEMONSTRATOR].get("scripted", True)
        self._simulated = WORLD in configs
        self._folder = Path(configs[GOALS]["folder"]) if GOALS in configs else None
        self._asked: dict[str, Teach | Restore | Look] = {}
        """Commands by id, until the stage takes them up."""
        self._caused_look: tuple[str, ...] = ()
        """Ids of what the newest look was asked for by."""
        self._job: Job | None = None
        self._goals: dict[str, Remembered] = {}
        self._unread: tuple[str, ...] = ()
        """What else is in the folder of goals, and why it is none."""
        self._photo: Photo | None = None
        self._moved = False
        """Whether something was moved since the picture was taken."""
        self._recognised: SceneEstimate | None = None
        self._estimate: SceneEstimate | None = None
        self._scene: SceneGraph | None = None
        self._ended: tuple[Goal | Verdict, str] | None = None
        """How the last job ended, and the id of the message that said so."""
        self._failed: list[tuple[Job, Outcome]] = []
        """Transfers of the newest job that failed, and how far it was then."""
        self._steps_s: list[float] = []
        """How long transfers took so far, with the look and the plan that follow."""
        self._draws = 0
        """Disturbed scenes so far: each number draws another."""

    # ------------------------------------------------------------------------------------------ what is heard

    def hear(self, heard: Heard) -> None:
        """Takes a message."""
        match heard.message:
            case Teach() | Restore() | Look() as command:
                self._ask(command, heard)
            case LookRequest(purpose=look) | Frame(name=look) if look.startswith(OWN_ARM):
                self._at("turn" if look == CAMERAS_WAY else "show")
            case LookRequest() | Recover():
                if not heard.id.startswith(f"{CORRECTOR}."):  # which passes on what was heard before
                    self._begin(heard)
            case Frame() as frame:
                self._photo = Photo(heard.id.replace("#", "-"), frame.rgb)
                self._recognised = self._estimate = self._scene = None
                self._moved = False
                self._at("recognise")
            case SceneEstimate() as estimate:
                self._recognised = self._estimate = estimate
            case SceneGraph() as scene:
                self._see(scene)
            case Move() as move:
                self._moved = True
                self._scene = self._scene and _with_moved(self._scene, move)
            case Arrange() | Arrangement() as arranged:
                self._moved, self._scene = True, None
                self._draws += arranged.kind == "start"
            case Kept(goals=goals, faults=faults):
                self._keep(goals, faults)
            case Goal() | Verdict() as end:
                self._end(end, heard.id)
            case _:
                self._work(heard)

    def _work(self, heard: Heard) -> None:
        """What moves a job on."""
        if self._job is None:
            return
        match heard.message:
            case Stop():
                self._job = replace(self._job, stopping=True)
            case Task(current=scene):
                self._agree(scene, self._job.answers)
                holders = {item.name for item in scene.objects if self._catalogue[item.label].concave}
                self._job = replace(self._job, phase="plan", holders=frozenset(holders))
            case Plan(transfers=transfers):
                planned = (*self._job.transfers[: self._job.done], *transfers)
                waits = bool(transfers) and (self._job.asks or self._job.pausing)
                step_ns = 0 if waits else self._job.step_ns
                self._job = replace(self._job, transfers=planned, waits=waits, asks=False, step_ns=step_ns)
            case TransferRequest():
                self._step(heard.time_ns)
            case Outcome(number=number) as outcome if number:  # else the arm came home, or did not
                self._moved, self._scene = True, None
                if not outcome.success:
                    self._failed.append((self._job, outcome))
                self._job = replace(self._job, done=number)
            case _:
                self._job = _talked(self._job, heard.message)

    def _agree(self, scene: SceneGraph, answers: Mapping[str, str]) -> None:
        """The scene that is planned in: names and stances are what the person has answered, what is hidden is known."""
        self._scene = scene
        if self._recognised is not None and answers:
            self._estimate = _as_answered(self._recognised, scene, meant(answers))

    def _step(self, time_ns: int) -> None:
        """A transfer begins: how long steps take is learned from one to the next."""
        assert self._job is not None
        if self._job.step_ns:
            self._steps_s.append((time_ns - self._job.step_ns) * 1e-9)
        self._job = replace(self._job, phase="move", waits=False, question=None, step_ns=time_ns)

    @property
    def _step_seconds(self) -> float:
        return median(self._steps_s) if self._steps_s else STEP_SECONDS

    def _begin(self, heard: Heard) -> None:
        """A look, or first the way home of an arm that was stopped: the begin of a job that somebody asked for, or one
        more look of the same."""
        self._caused_look = heard.causes
        asked = [self._asked.pop(cause) for cause in heard.causes if cause in self._asked]
        if asked:
            self._start(asked[0], heard.time_ns)
        else:
            self._job = self._job or Job("", heard.time_ns)
            self._at("check" if self._job.done else "look")

    def _ask(self, command: Teach | Restore | Look, heard: Heard) -> None:
        """A command; it may be recorded after what the stage did when it took it up."""
        if heard.id in self._caused_look:
            self._start(command, heard.time_ns)
        else:
            self._asked[heard.id] = command

    def _start(self, command: Teach | Restore | Look, time_ns: int) -> None:
        self._ended, self._failed = None, []
        match command:
            case Teach(name=name):
                self._job = Job(name, time_ns, phase="teach")
            case Restore(name=name):
                self._job = Job(name, time_ns, phase="restore", asks=command.ask)
            case Look():
                self._job = Job("", time_ns)

    def _at(self, phase: Phase) -> None:
        if self._job is not None:
            self._job = replace(self._job, phase=phase)

    def _see(self, scene: SceneGraph) -> None:
        self._scene = scene
        if self._job is not None and not self._job.name and self._commanded:
            self._job = None  # it was a look, no more

    def _end(self, end: Goal | Verdict, id: str) -> None:
        if isinstance(end, Verdict) and end.failed_stage == DEMONSTRATOR and self._job is not None:
            return  # somebody else, who asked meanwhile, was refused
        if isinstance(end, Goal) and self._folder is None:  # else Kept says so, which may be heard before this goal
            self._goals[end.name] = Remembered(end, self._photo)
        self._ended, self._job = (end, id), None

    def recall(self) -> None:
        """Takes the goals that are on disk."""
        if self._folder is not None:
            goals, faults = GoalFolder(self._folder, self._catalogue).read()
            self._keep(goals.values(), faults)

    def _keep(self, goals: Iterable[Goal], faults: Iterable[str]) -> None:
        self._goals, self._unread = {goal.name: Remembered.of(goal) for goal in goals}, tuple(faults)

    # ------------------------------------------------------------------------------------------ what is told

    def tell(self, language: Language) -> Told:
        """What there is to say."""
        words = words_of(language)
        return Told(
            doing=self._doing(words),
            question=self._question(words),
            notice=self._notice(words),
            view=self._view(words),
            statements=tuple(self._statements(words)),
            actions=tuple(self._actions(words)) if self._commanded else (),
            map=self._map(words),
            cards_title=words.say("goals"),
            cards_hint=words.say("no_goals"),
            cards=tuple(self._cards(words)),
            cards_actions=(add(words),) if self._folder else (),
        )

    def say(self, refusal: str, language: Language) -> str:
        """Why a stage refused a call, as a sentence."""
        words = words_of(language)
        return words.capital(reasons.told(refusal, words))

    def _cards(self, words: Words) -> Iterator[Card]:
        for name, kept in self._goals.items():
            asked = {"name": name, "ask": "true"}
            label, now = words.say("do_restore"), self._job is None
            restore = Action(DEMONSTRATOR, "restore", label, asked, kind="first", now=now)
            yield card(kept, (restore,) if self._commanded else (), words)
        for fault in self._unread:
            folder, _, why = fault.partition(": ")
            yield Card(folder, Path(folder).name, why, None, ())

    def _doing(self, words: Words) -> Doing:
        job = self._job
        if job is None:
            return Doing(words.say("idle" if self._commanded else "script"))
        steps = tuple(_move(transfer, job, words) for transfer in job.transfers)
        step = min(job.done + 1, len(steps))
        expected = 0.0
        if job.step_ns:
            left = (len(steps) - job.done) * self._step_seconds
            expected = (job.step_ns - job.began_ns) * 1e-9 + left
        return Doing(self._what(job, steps, step, words), True, steps, step, job.began_ns, expected)

    def _what(self, job: Job, steps: tuple[str, ...], step: int, words: Words) -> str:
        """What the robot does, or waits for."""
        if job.stopping:
            return words.say("stopping")
        if job.question is not None:
            return words.say("asks")
        if job.waits:
            minutes = (len(steps) - job.done) * self._step_seconds / 60
            return words.say("waits", count=len(steps) - job.done, minutes=max(1, round(minutes)))
        text = steps[step - 1] if job.phase == "move" else words.say(job.phase, name=job.name)
        return words.say("pausing", text=text) if job.pausing else text

    def _question(self, words: Words) -> Question | None:
        """What the person is asked."""
        asked = self._job.question if self._job else None
        if asked is None:
            return None
        doubt = asked.doubt
        noun = words.noun(doubt.object)
        key = f"ask_{doubt.stance.replace(' ', '_')}" if doubt.kind == "stance" else f"ask_{doubt.kind}"
        answers = tuple(
            Action(
                DEMONSTRATOR,
                "answer",
                words.capital(words.bare(choice)) if choice in names else words.say(f"answer_{choice}"),
                {"question": str(asked.number), "choice": choice},
                kind="first" if choice == doubt.choices[0] and doubt.kind != "which" else "plain",
            )
            for names in [_names(self._scene)]
            for choice in doubt.choices
        )
        about = {"unknown": region_name(0), "stance": doubt.object, "which": ""}[doubt.kind]
        return Question(words.say(key, object=noun), answers, about)

    def _view(self, words: Words) -> View | None:
        if self._photo is None:
            return None
        height, width = self._photo.rgb.shape[:2]
        found = outlines(self._estimate, self._catalogue, (height, width), words) if self._estimate else ()
        arrows = tuple(self._arrows(words))
        return View(self._photo, words.say("outdated" if self._moved else "seen"), found, arrows)

    def _arrows(self, words: Words) -> Iterator[Arrow]:
        """What will be moved and is not hidden, from where it will be then."""
        job, scene = self._job, self._scene
        if job is None or scene is None or scene.T_base_camera is None:
            return
        places = {item.name: item.T_base_object for item in scene.objects}
        for transfer in job.transfers[job.done :]:
            if transfer.object not in places:
                continue
            start, end = places[transfer.object], transfer.T_base_targets[0]
            pixels = (pixel(T[:3, 3], scene.T_base_camera, scene.K) for T in (start, end))
            yield Arrow(_move(transfer, job, words), *pixels)
            places[transfer.object] = end

    def _statements(self, words: Words) -> Iterator[Statement]:
        if self._moved and self._job is None and self._photo:
            yield Statement(words.say("moved"), surety="unknown")
        elif self._scene is not None:
            yield from self._known(self._scene, words)

    def _known(self, scene: SceneGraph, words: Words) -> Iterator[Statement]:
        """What is there, and what stands on, in or next to what."""
        judged = {item.name: item for item in self._estimate.objects} if self._estimate else {}
        beside: dict[str, list[str]] = {}
        for virtual in scene.virtual_objects:
            beside.setdefault(virtual.child, []).append(virtual.parent)
        for name, (supporter, how) in support(scene).items():
            text = words.say(f"is_{how}", child=words.noun(name), supporter=words.noun(supporter))
            if name in beside:
                text += words.say("beside", parents=words.nouns(beside[name]))
            ties = [Tie("carried", words.part(f"tie_{how}"), supporter, words.bare(supporter))]
            for parent in beside.get(name, ()):
                ties.append(Tie("beside", words.part("tie_beside"), parent, words.bare(parent)))
            told = _statement(f"{text}.", name, judged.get(name), words)
            yield replace(told, label=words.bare(name), ties=tuple(ties))
        for number, region in enumerate(self._estimate.unknown if self._estimate else ()):
            size = " x ".join(f"{100 * edge:.0f}" for edge in region.extent_table)
            text = words.say("unknown", size=size)
            yield Statement(f"{text}.", region_name(number), "unknown", words.say("unexplained"))

    def _actions(self, words: Words) -> Iterator[Action]:
        idle = self._job is None
        ask = Ask("name", words.say("name"), words.say("name_hint"), NAME)
        if self._job is not None and self._job.waits:
            yield Action(DEMONSTRATOR, "go", words.say("do_go"), {}, kind="first")
        if self._job is not None and self._job.transfers and not (self._job.waits or self._job.pausing):
            yield Action(DEMONSTRATOR, "pause", words.say("do_pause"), {}, now=not self._job.stopping)
        if self._job is not None and self._job.pausing and not self._job.waits:
            yield Action(DEMONSTRATOR, "go", words.say("do_no_pause"), {})
        yield Action(DEMONSTRATOR, "teach", words.say("do_teach"), {"ask": "true"}, ask, kind="first", now=idle)
        yield Action(DEMONSTRATOR, "look", words.say("do_look" if self._photo else "do_first_look"), {}, now=idle)
        if self._simulated:
            draw = {"draw": str(self._draws)}
            yield Action(WORLD, "arrange", words.say("do_disturb"), {"kind": "start", **draw}, now=idle)
            yield Action(WORLD, "arrange", words.say("do_lay_out"), {"kind": "goal"}, now=idle)
        yield Action(DEMONSTRATOR, "stop", words.say("do_stop"), {"now": "true"}, kind="stop")

    def _map(self, words: Words) -> Map | None:
        """The scene from above, where people may move what carries nothing; None where there is nothing to move."""
        scene = self._scene
        if scene is None or not scene.objects or not (self._simulated and self._commanded and self._job is None):
            return None
        carried = support(scene)
        carriers = {supporter for supporter, _ in carried.values()}
        objects = sorted(scene.objects, key=lambda item: item.T_base_object[2, 3])
        places = tuple(
            Place(
                item.name,
                words.bare(item.name),
                footprint(self._catalogue[item.label], item.T_base_object),
                float(item.T_base_object[0, 3]),
                float(item.T_base_object[1, 3]),
                item.name not in carriers,
            )
            for item in objects
        )
        return Map(words.say("map"), words.say("map_hint"), ground(scene), places, WORLD, "move")

    # ------------------------------------------------------------------------------------------ how it ended

    def _notice(self, words: Words) -> Notice | None:
        if self._ended is None:
            return None
        end, id = self._ended
        if isinstance(end, Goal):
            names = [item.name for item in end.scene.objects]
            return Notice(True, words.say("remembered", name=end.name, objects=words.nouns(names)), message=id)
        if end.success:
            _, _, besides = reasons.told(end.reason, words).partition("; ")
            notes = (f"{words.capital(besides)}.",) if besides else ()
            return Notice(True, words.say("restored", name=end.goal_name), notes, message=id)
        if end.failed_stage == STOPPED:
            return Notice(True, f"{words.capital(reasons.told(end.reason, words))}.", message=id)
        key = "failed" if end.goal_name in self._goals else "not_remembered"
        help = (words.say(f"at_{end.failed_stage}"), *self._faults(end, words), words.say(f"help_{end.failed_stage}"))
        text = words.say(key, name=end.goal_name, reason=reasons.told(end.reason, words))
        return Notice(False, text, help, id, tuple(self._attempts(words)))

    def _attempts(self, words: Words) -> Iterator[str]:
        """What was tried in vain."""
        if self._failed:
            yield words.say("tried")
        for job, failed in self._failed:
            step = _move(job.transfers[failed.number - 1], job, words)
            reason = reasons.told(f"{failed.failed_stage}: {failed.reason}", words)
            yield words.say("tried_step", step=step, reason=reason)

    def _faults(self, verdict: Verdict, words: Words) -> list[str]:
        """What is not where it belongs, as sentences."""
        kept = self._goals.get(verdict.goal_name)
        virtual = {item.name: item for item in kept.goal.scene.virtual_objects} if kept else {}
        found: list[str] = []
        for item in verdict.violated:
            if item.predicate in ("on", "in") and item.arguments[0] not in virtual:
                child, supporter = map(words.noun, item.arguments)
                found.append(words.say(f"should_{item.predicate}", child=child, supporter=supporter))
            elif item.predicate == "faces":
                name, side = item.arguments
                found.append(words.say("should_face", object=words.noun(name), side=words.part(f"side_{side}")))
            elif item.predicate == "in":
                region = virtual[item.arguments[0]]
                parts = {"child": words.noun(region.child), "parent": words.noun(region.parent)}
                found.append(words.say("should_beside", **parts))
        return found[:SHOWN_FAULTS]


def _names(scene: SceneGraph | None) -> set[str]:
    return {item.name for item in scene.objects} if scene else set()


def _statement(text: str, name: str, item: ObjectPose | None, words: Words) -> Statement:
    return Statement(text, name) if item is None else Statement(text, name, surety(item), how_sure(item, words))


def _talked(job: Job, message: Message) -> Job:
    """A job after what the robot and the person have said to each other."""
    match message:
        case AskedQuestion() as question:
            return replace(job, question=question, step_ns=0)
        case Answer(question=number, choice=choice):
            asked = job.question
            taken = asked is not None and asked.number == number and choice in asked.doubt.choices
            answers = job.answers if choice == "again" or asked is None else {**job.answers, asked.doubt.key: choice}
            return replace(job, question=None, answers=answers) if taken else job
        case Pause():
            return replace(job, pausing=True)
        case Go():
            return replace(job, pausing=False, waits=False, asks=False)
        case _:
            return job


def _as_answered(estimate: SceneEstimate, scene: SceneGraph, names: Mapping[str, str]) -> SceneEstimate:
    """What was seen, with the names and poses that it has in a scene, for a picture of it."""
    there = {item.name: item.T_base_object for item in scene.objects}
    to_camera = None if estimate.T_base_camera is None else inverse(estimate.T_base_camera)

    def answered(item: ObjectPose) -> ObjectPose:
        name = names.get(item.name, item.name)
        if to_camera is None or item.contradicted or name not in there:
            return msgspec.structs.replace(item, name=name)
        return msgspec.structs.replace(item, name=name, T_camera_object=to_camera @ there[name])

    return msgspec.structs.replace(estimate, objects=tuple(map(answered, estimate.objects)))


def _move(transfer: Transfer, job: Job, words: Words) -> str:
    """A transfer as a sentence."""
    key = "put_in" if transfer.destination in job.holders else "put_on"
    return words.say(key, object=words.noun(transfer.object), destination=words.noun(transfer.destination))


def _with_moved(scene: SceneGraph, move: Move) -> SceneGraph:
    """A scene in which somebody has put an object elsewhere; the next look says what it stands on now."""
    objects = (_moved(item, move) if item.name == move.name else item for item in scene.objects)
    return msgspec.structs.replace(scene, objects=tuple(objects))


def _moved(item: SceneObject, move: Move) -> SceneObject:
    T = item.T_base_object.copy()
    T[:2, 3] = move.x, move.y
    return msgspec.structs.replace(item, T_base_object=T)
