"""Current scene and goal in, plan out: transfers with poses that would do, or the reason why there are none."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from msgspec.structs import replace as replace_fields

from runner.contract import Context, Refused, Stage
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import Assertion, Plan, SceneGraph, Task, Transfer
from stages.planning.places.hiding import uncovers
from stages.planning.places.placements import Placements, Scene
from stages.planning.stepwise import hopeless, shortened, stepwise
from stages.planning.symbolic import search
from stages.planning.symbolic.pddl import problem_pddl
from stages.planning.symbolic.problem import TABLE, Problem, cycle, wanted
from stages.planning.symbolic.search import Solution, Step
from stages.planning.targets import Blocked, Crowded, Targets, Workspace, neighbours
from stages.robots import BUILT_IN, read_robot
from stages.scene.catalogue import Catalogue
from stages.scene.domain import DOMAIN
from stages.scene.facing import sides
from stages.scene.stance import Stances, Standing, standing_of
from stages.scene.virtual import fallen, rerooted, satisfied

if TYPE_CHECKING:
    from stages.planning.handling import Handling

SEARCHES = 16
"""Times that a plan is searched for, each knowing more of what is in the way."""
_LOOKS = 100
"""Times that places are looked for before no other search begins."""
_ASIDE = 100
"""Places that are considered for what is put aside to see behind it."""


class Impossible(Exception):
    """No plan reaches the goal; the text says why and names the objects."""

    def __init__(self, why: str, blocked: Blocked | None = None) -> None:
        super().__init__(why)
        self.blocked = blocked
        """The last step that had no place; None where none was tried."""


@dataclass(frozen=True)
class Attempt:
    """A plan in the making: what has to be moved out of the way, and what should be placed late."""

    problem: Problem
    reluctant: frozenset[str]
    regrasped: frozenset[str] = frozenset()
    """What is put aside first: the hand cannot turn it at once, or has failed with it again and again."""

    def steps(self, found: Sequence[Step]) -> list[Step]:
        """What the search found, with a step more for what is regrasped, unless it is put aside anyway; what moves
        again is put aside on the table, wherever the search has it meanwhile."""
        last = {step.item: number for number, step in enumerate(found)}
        steps, aside = list[Step](), set[str]()
        for number, step in enumerate(found):
            final = number == last[step.item]
            if not final or step.item in self.regrasped - aside:
                steps.append(Step(step.item, TABLE if step.item in aside else step.source, TABLE))
                aside.add(step.item)
            if final:
                steps.append(replace(step, source=TABLE) if step.item in aside else step)
        return steps

    def after(self, blocked: Blocked, steps: Sequence[Step]) -> Attempt | None:
        """The attempt that makes room for a step, or None where nothing is left to try.

        What the hand cannot put down on another side is laid down in between.
        What stands in the way is moved first, or placed later if the plan itself put it there. A region without
        room may have it elsewhere, and what carries the object may stand where the hand does not get above it: then
        what the object goes beside is moved first, or what that is beside, and so on; or else what carries it. What
        the object goes beside and is in the hand's way would be so wherever it stood.
        """
        step, problem = blocked.step, self.problem
        if blocked.why and step.item in problem.turned - self.regrasped:
            return replace(self, regrasped=self.regrasped | {step.item})
        earlier = {before.item for before in steps[: steps.index(step)]}
        obstacles = problem.graspable & set(blocked.obstacles) - {step.parent}
        beside = [name for name in problem.beside(step.item) if name not in blocked.obstacles] if step.region else []
        below = [step.destination, *problem.beside(step.destination)] if step.destination != TABLE else []
        for names in (obstacles, *({name} for name in (*beside, *below))):
            placed = names & earlier
            if placed - self.reluctant:
                return replace(self, reluctant=self.reluctant | placed)
            where = step.region or step.destination
            added = {(name, step.item, where) for name in names & problem.graspable - earlier}
            meanwhile = placed & obstacles - {step.destination, step.parent}
            added |= {(step.item, name, problem.finally_at(name)) for name in meanwhile}
            if added - problem.obstructions:
                return replace(self, problem=replace(problem, obstructions=problem.obstructions | added))
        return None


class Planner(Stage):
    """Plans at the level of the scene graph, then finds poses for every transfer of the plan."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """What to plan with, and where the robot can place."""

        catalogue: Path
        robot: Path = BUILT_IN
        engine: str = search.BFS
        """``bfs``, or the name of an installed unified-planning engine."""
        gripper_width: float | None = None
        """Widest object the gripper shall take between its fingers, metres; None: as the robot's description says."""
        workspace: Workspace = field(default_factory=Workspace)

        def __post_init__(self) -> None:
            """Refuses a gripper that does not open."""
            if self.gripper_width is not None and not self.gripper_width > 0:
                raise Refused(f"planner.gripper_width={self.gripper_width}: must be a positive number of metres")

    def __init__(self, config: Config) -> None:
        # Motion planning takes half a second to load; whoever only reads a graph does without.
        from stages.planning.handling import Handling
        from stages.planning.motion.motion import warm_up
        from stages.planning.motion.unknown import unknown_objects

        search.check_engine(config.engine)
        self._handling, self._unknown_objects = Handling, unknown_objects
        self._config = config
        robot = read_robot(config.robot)
        widest = min(config.gripper_width or np.inf, robot.gripper.widest)
        self._robot = replace(robot, gripper=replace(robot.gripper, widest=widest))
        warm_up(self._robot)
        self._catalogue = Catalogue.shared(config.catalogue)
        self._stances = {label: Stances(item) for label, item in self._catalogue.objects.items()}

    def on_task(self, task: Task, ctx: Context) -> Plan:
        """A plan whose every transfer has poses, or a refusal before anything moves."""
        for scene in (task.goal, task.current):
            if scene.frame != "base":
                return _answer("refused", "", reason=_nowhere(scene))
        there = {item.name for item in task.current.objects}
        task = replace_fields(task, avoid=tuple(key for key in task.avoid if _moved(key)[0] in there))
        if task.aside:
            return self._put_aside(task, ctx)
        missing = {item.name for item in task.goal.objects} - there
        if missing:
            return _answer("refused", "", reason=f"the goal needs {_listed(missing)}, not in the current scene")
        plan = self._plan(task, task.goal, ctx)
        if plan.status != "solved":
            return plan
        held, _ = satisfied(task.goal, task.current, self._catalogue)
        return replace_fields(plan, at_least=search.fewest(self._problem(task, held)))

    def _plan(self, task: Task, taught: SceneGraph, ctx: Context) -> Plan:
        """A plan for the task's goal, which may tell the regions that were ``taught`` the other way round."""
        held, violated = satisfied(task.goal, task.current, self._catalogue, taught=taught)
        problem = self._problem(task, held)
        text = problem_pddl(task.goal_name, problem, task.current, task.goal)
        if not violated:
            return _answer("satisfied", text)
        steps = search.continued(task.then, problem)
        if steps and steps[0].key not in task.avoid and task.goal is taught:
            targets, scene = self._targets(problem, task, taught, ctx), self._scene(task)
            poses = targets.of(
                steps, scene, again=_failed_before(steps, task.avoid), late=problem.items, what="the rest"
            )
            if isinstance(poses, list):
                left = list(zip(steps, poses, strict=True))
                # A detour that makes room for what failed looks needless: the planner found room before it failed, too.
                return _solved(left if task.avoid else shortened(left, problem, targets, scene), text, problem)
        try:
            self._check(problem, task, violated[0])
            self._check_grasps(problem, self._scene(task), ctx)
            return self._solve_with_room(problem, task, taught, ctx)
        except Impossible as reason:
            refused, blocked = _answer("refused", text, reason=str(reason)), reason.blocked
        if task.goal is not taught or blocked is None:
            return refused
        return self._another_way(task, problem, blocked, refused, ctx)

    def _another_way(self, task: Task, problem: Problem, blocked: Blocked, refused: Plan, ctx: Context) -> Plan:
        """What the search does not find. Where an object is in the way of the hand that puts another one beside it, the
        other one comes first; else one transfer is planned after the other, unless there is no such place beside what
        nobody can move."""
        taught, step = task.goal, blocked.step
        if step.region and not (blocked.why or problem.graspable.intersection(blocked.involved - {step.item})):
            return refused
        beside = problem.graspable.issuperset(problem.beside(step.item))
        if step.parent in blocked.obstacles and beside:
            ctx.log(f"{refused.reason}; places {step.item} first")
            plan = self._plan(replace_fields(task, goal=rerooted(taught, step.item)), taught, ctx)
            if plan.status == "solved":
                return plan
        ctx.log(f"{refused.reason}; plans one transfer after the other")
        targets, scene = self._targets(problem, task, taught, ctx), self._scene(task)
        steps = stepwise(problem, targets, scene, ctx.rng, avoided=task.avoid)
        if steps is None:
            return refused
        steps = shortened(steps, problem, targets, scene, avoided=task.avoid)
        return _solved(steps, refused.problem_pddl, problem)

    def _put_aside(self, task: Task, ctx: Context) -> Plan:
        """One transfer, to a place on the table where the object hides nothing of what it hides now; of what keeps the
        hand from it, where something does."""
        scene = self._scene(task)
        workspace = replace(self._config.workspace, targets=_ASIDE)
        handling = self._handling(self._robot, self._robot.table, ctx.rng)
        targets = Targets(Placements(task.current, self._stances, task.current), workspace, self._robot, handling, {})
        problem = self._problem(task, ())
        ahead, tried = [task.aside], list[str]()
        while ahead:
            name = ahead.pop()
            tried.append(name)
            step = Step(name, scene.supports[name], TABLE)
            poses = targets.of((step,), scene)
            if isinstance(poses, list):
                return self._uncovering(step, poses[0], scene, problem, handling)
            if isinstance(poses, Blocked):
                tops = problem.graspable.intersection(poses.obstacles).difference(tried, scene.supports.values())
                ahead += sorted(tops, reverse=True)
        return _answer("refused", "", reason=f"no room to put {task.aside} aside")

    def _uncovering(
        self, step: Step, T_base_targets: Floats, scene: Scene, problem: Problem, handling: Handling
    ) -> Plan:
        """The transfer to those places where the object hides nothing of what it hides now, from the first on that the
        hand gets to."""
        item, T_table_base = scene.standing[step.item], inverse(scene.T_base_table)
        stances = self._stances[item.stance.item.name]
        places = ((T, Standing.at(step.item, stances, T_table_base @ T)) for T in T_base_targets)
        free = [(T, place) for T, place in places if scene.eye is None or uncovers(item, place, scene.eye)]
        if not free:
            return _answer("refused", "", reason=f"wherever {step.item} could be put, it would hide the same")
        first = next(handling.of(step, scene, [place for _, place in free]).places(), None)
        if first is None:
            return _answer("refused", "", reason=f"no room to put {step.item} aside")
        chosen = np.stack([T for T, _ in free[first:][: self._config.workspace.targets]])
        return _answer("solved", "", transfers=[_transfer(step, chosen, problem, faces=False)])

    def _problem(self, task: Task, held: Sequence[Assertion]) -> Problem:
        regions = {item.name for item in task.goal.virtual_objects}
        inside = (item.arguments for item in held if item.predicate == "in")
        graspable = frozenset(item.name for item in task.current.objects if not self._why_not(item.label))
        return Problem.between(
            task.current,
            task.goal,
            held=frozenset(child for region, child in inside if region in regions),
            graspable=graspable,
            turned=fallen(task.goal, task.current, self._catalogue).intersection(wanted(task.goal))
            | frozenset(sides(task.goal)) - {item.arguments[0] for item in held if item.predicate == "faces"}
            | self._leaning(task, held) & graspable,
        )

    def _leaning(self, task: Task, held: Sequence[Assertion]) -> frozenset[str]:
        """What leans as the goal does not show it, and does not carry what it should: nothing can be put there before
        it is set upright."""
        there, belongs = {item.arguments for item in held if item.predicate in ("on", "in")}, wanted(task.goal)
        lacking = {support for item, support in belongs.items() if (item, support) not in there}
        straight, shown = (
            {item.name for item in standing_of(scene.objects, self._stances, scene.T_base_table) if item.stance.aligned}
            for scene in (task.current, task.goal)
        )
        return frozenset(lacking & shown - straight).intersection(belongs)

    def _why_not(self, label: str) -> str:
        """Why the robot cannot grasp an object; empty where it can."""
        grasps = self._catalogue[label].grasps
        if not grasps:
            return "has no grasp in the catalogue"
        narrowest = min(grasp.width for grasp in grasps)
        widest = self._robot.gripper.widest
        if narrowest <= widest:
            return ""
        return f"is {100 * narrowest:.1f} cm wide and the gripper takes {100 * widest:.1f} cm"

    def _check(self, problem: Problem, task: Task, violated: Assertion) -> None:
        """Raises :class:`Impossible` for goals that no search needs to look at."""
        if problem.satisfied():
            what = "no transfer changes what is violated: every object is where the goal has it"
            raise Impossible(f"{what}; {violated} does not hold")
        if circle := cycle(problem.goal):
            raise Impossible(f"in the goal {_listed(circle, sort=False)} rest on each other in a circle")
        if circle := cycle({item: region.parent for item, region in problem.regions.items()}):
            raise Impossible(f"in the goal {_listed(circle, sort=False)} are beside each other in a circle")
        labels = {item.name: item.label for item in task.current.objects}
        fixed = [item for item in problem.items if item not in problem.graspable]
        for item in fixed:
            support, wanted = problem.supports[item], problem.goal.get(item)
            why = self._why_not(labels[item])
            if wanted not in (None, support):
                raise Impossible(f"{item} would have to move from {support} to {wanted}, but it {why}")
            if item in problem.regions and item not in problem.held:
                raise Impossible(f"{item} would have to move beside {problem.regions[item].parent}, but it {why}")
            if item in problem.turned:
                raise Impossible(f"{item} would have to be turned, but it {why}")
            if support in problem.clear or problem.goal.get(support, TABLE) != problem.supports.get(support, TABLE):
                raise Impossible(f"{item} on {support} would have to move, but it {why}")

    def _check_grasps(self, problem: Problem, scene: Scene, ctx: Context) -> None:
        """Raises :class:`Impossible` where no hand takes what must be turned, were there nothing else."""
        handling = self._handling(self._robot, self._robot.table, ctx.rng)
        for item in sorted(problem.turned):
            step, standing = Step(item, TABLE, TABLE), scene.standing[item]
            alone = replace(scene, standing={item: standing}, supports={item: TABLE})
            handled = handling.of(step, alone, [standing])
            if next(handled.places(), None) is None:
                raise Impossible(_no_room(Blocked(step, (), handled.why_not()[0])))

    def _solve_with_room(self, problem: Problem, task: Task, taught: SceneGraph, ctx: Context) -> Plan:
        """Before a transfer that failed is tried again, what stands beside its object is moved out of the hand's way if
        it can be; one that failed in other places, too, is made by way of a place aside."""
        scene = self._scene(task)
        beside = {
            (neighbour, item, destination)
            for item, destination in (_moved(key) for key in task.avoid)
            for neighbour in neighbours(item, scene)[:1]
            if neighbour in problem.graspable
        }
        detours = frozenset(_moved(key)[0] for key in hopeless(task.avoid))
        roomy = replace(problem, obstructions=problem.obstructions | beside)
        for one in (*([roomy] if beside else ()), *([problem] if detours else ())):
            with suppress(Impossible):
                plan = self._solve(one, detours, task, taught, ctx)
                if one is problem or self._makes_room(plan, beside, scene):
                    return plan
        return self._solve(problem, frozenset(), task, taught, ctx)

    def _makes_room(self, plan: Plan, beside: Iterable[tuple[str, str, str]], scene: Scene) -> bool:
        """Whether what moves away from beside objects is then out of the way of the hand that picks them."""
        T_table_base, moves = inverse(scene.T_base_table), {move.object: move for move in reversed(plan.transfers)}
        for name, item, _ in beside:
            if not moves.keys() >= {name, item}:
                return False
            stances = self._stances[scene.standing[name].stance.item.name]
            place = Standing.at(name, stances, T_table_base @ moves[name].T_base_targets[0])
            if name in neighbours(item, scene.after(name, place, moves[name].destination)):
                return False
        return True

    def _solve(self, problem: Problem, detours: frozenset[str], task: Task, taught: SceneGraph, ctx: Context) -> Plan:
        """Searches, finds poses, and searches again with what was in the way, until every transfer has poses; what has
        to make ``detours`` is put aside first."""
        current, targets = self._scene(task), self._targets(problem, task, taught, ctx)
        blocked: Blocked | None = None
        attempt = Attempt(problem, frozenset(_moved(key)[0] for key in task.avoid), detours)
        for number in range(1, SEARCHES + 1):
            text = problem_pddl(task.goal_name, attempt.problem, task.current, task.goal)
            solution = self._search(attempt, text)
            if solution.steps is None:
                raise Impossible(_no_room(blocked) if blocked else _dead_end(attempt.problem, problem), blocked)
            found = attempt.steps(solution.steps)
            again = _failed_before(found, task.avoid)
            poses = targets.of(found, current, again=again, late=attempt.reluctant, what=f"search {number}")
            if isinstance(poses, Crowded):
                attempt = replace(attempt, reluctant=attempt.reluctant | {poses.step.item})
                continue
            if not isinstance(poses, Blocked):
                steps = zip(found, poses, strict=True)
                if attempt.problem != problem or attempt.regrasped != detours:
                    # What was thought to be in the way need not be.
                    steps = shortened(steps, problem, targets, current, avoided=task.avoid)
                return _solved(steps, text, attempt.problem, expanded=solution.expanded)
            blocked, following = poses, attempt.after(poses, found)
            if following is None or targets.looked > _LOOKS:
                break
            ctx.log(f"{_no_room(blocked)}; looks for another way")
            attempt = following
        raise Impossible(_no_room(blocked) if blocked else _no_order(attempt.reluctant), blocked)

    def _scene(self, task: Task) -> Scene:
        """What stands there now, known or not."""
        graph = task.current
        scene, T_table_base = Scene.of(graph, self._stances), inverse(graph.T_base_table)
        objects = {item.name: (self._catalogue[item.label], item.T_base_object) for item in graph.objects}
        table = self._robot.table.seen(graph.T_base_table, graph.support)
        for name, (box, T) in self._unknown_objects(graph, objects, self._robot, table).items():
            scene = scene.after(name, Standing.at(name, Stances(box), T_table_base @ T), TABLE)
        return scene

    def _targets(self, problem: Problem, task: Task, taught: SceneGraph, ctx: Context) -> Targets:
        handling = self._handling(self._robot, self._robot.table, ctx.rng, problem.faced)
        placements = Placements(task.goal, self._stances, taught)
        # What may be anywhere is turned on the table.
        goal = dict.fromkeys(problem.faced, TABLE) | wanted(task.goal)
        return Targets(
            placements, self._config.workspace, self._robot, handling, goal, turned=problem.turned, log=ctx.log
        )

    def _search(self, attempt: Attempt, text: str) -> Solution:
        if self._config.engine == search.BFS:
            return search.breadth_first(attempt.problem, reluctant=attempt.reluctant)
        return search.with_engine(self._config.engine, text, attempt.problem)


def _transfer(step: Step, T_base_targets: Floats, problem: Problem, *, faces: bool) -> Transfer:
    pick, place = search.actions(step, problem)
    return Transfer(
        object=step.item,
        source=step.source,
        destination=step.destination,
        T_base_targets=T_base_targets,
        pick=pick,
        place=place,
        faces=faces,
    )


def _solved(steps: Iterable[tuple[Step, Floats]], text: str, problem: Problem, *, expanded: int = 0) -> Plan:
    """On its last way an object comes to show the side that the goal has, not before."""
    every = list(steps)
    last = {step.item: number for number, (step, _) in enumerate(every) if step.item in problem.faced}
    transfers = [
        _transfer(step, poses, problem, faces=last.get(step.item) == number)
        for number, (step, poses) in enumerate(every)
    ]
    return _answer("solved", text, transfers=transfers, expanded=expanded)


def _answer(
    status: Literal["satisfied", "solved", "refused"],
    problem: str,
    *,
    reason: str = "",
    transfers: Sequence[Transfer] = (),
    expanded: int = 0,
) -> Plan:
    return Plan(
        status=status,
        reason=reason,
        transfers=tuple(transfers),
        actions=tuple(action for transfer in transfers for action in (transfer.pick, transfer.place)),
        domain_pddl=DOMAIN,
        problem_pddl=problem,
        expanded=expanded,
    )


def _nowhere(scene: SceneGraph) -> str:
    return (
        f"scene '{scene.name}' has its poses in the table's frame, for the camera's pose in the robot's base frame is "
        "not known; the camera must say it (T_base_camera)"
    )


def _failed_before(steps: Iterable[Step], avoid: Collection[str]) -> list[Step]:
    """Steps whose transfer is one of those to avoid."""
    return [step for step in steps if step.key in avoid]


def _moved(key: str) -> tuple[str, str]:
    """Object and destination of a transfer's key."""
    item, _, way = key.partition(": ")
    return item, way.partition(" -> ")[2]


def _dead_end(attempted: Problem, original: Problem) -> str:
    added = attempted.obstructions - original.obstructions
    if added:
        obstacles = {obstacle for obstacle, _, _ in added}
        return f"{_listed(obstacles)} would have to make room and cannot"
    moving = {item for item, support in original.goal.items() if original.supports[item] != support}
    fixed = {item for item in original.items if item not in original.graspable}
    return f"no sequence of transfers moves {_listed(moving)} while {_listed(fixed) or 'nothing'} cannot be moved"


def _no_order(crowding: Iterable[str]) -> str:
    return f"no order of transfers leaves room for the hand: {_listed(crowding)} in the way"


def _no_room(blocked: Blocked) -> str:
    step = blocked.step
    if blocked.why:
        among = f" ({_listed(blocked.obstacles)} in the way)" if blocked.obstacles else ""
        return f"{step.item} cannot be taken from {step.source} to {step.destination}: {blocked.why}{among}"
    where = f"on the table for {step.item}" if step.destination == TABLE else f"for {step.item} at {step.destination}"
    because = f": {_listed(blocked.obstacles)} in the way" if blocked.obstacles else ""
    return f"no room {where} within reach{because}"


def _listed(names: Iterable[str], *, sort: bool = True) -> str:
    return ", ".join(sorted(names) if sort else names)
