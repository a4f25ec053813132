"""The report: keeps what happened, writes it beside the recording, prints it and ends the graph."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from runner.contract import Context, Finished, Restarted, Stage
from stages.messages import (
    Candidates,
    Goal,
    Outcome,
    Plan,
    SceneEstimate,
    SceneGraph,
    Snapshot,
    Verdict,
)
from stages.scene.catalogue import Catalogue
from stages.scene.episode import Episode, ReportedLook, markdown, plain, title
from stages.scene.scoring import errors
from stages.scene.text import certainty
from stages.scene.truth import Truth


class Report(Stage):
    """The only reader of the simulator's truth besides the camera that renders it: to score perception and to judge.

    The graph succeeds where the verdict does and the truth does not deny it.

    Messages of different stages arrive in any order. The verdict says how many looks, plans and transfers led
    to it, and the report ends once it has all of them.
    """

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """What perception is scored and the end is judged with."""

        catalogue: Path

    def __init__(self, config: Config) -> None:
        self._catalogue = Catalogue.shared(config.catalogue)
        self._truth = Truth(self._catalogue)
        self._looks: list[tuple[int, ReportedLook, Snapshot]] = []
        self._plans: list[Plan] = []
        self._outcomes: dict[int, Outcome] = {}
        self._restarts: list[str] = []
        self._goals: dict[str, Goal] = {}
        self._verdict: Verdict | None = None

    def on_look(
        self,
        snapshot: Snapshot,
        candidates: Candidates,
        scene_estimate: SceneEstimate,
        scene_graph: SceneGraph,
        ctx: Context,
    ) -> Finished | None:
        """Scores one look against the truth of the instant it was taken."""
        look = ReportedLook(
            purpose=snapshot.purpose,
            boxes=len(candidates.candidates),
            hypotheses=len(scene_estimate.log_weights),
            left_out=scene_estimate.left_out,
            scene=scene_graph,
            errors=errors(snapshot.names, snapshot.T_base_objects, scene_graph.objects, self._catalogue),
            certainty=certainty(scene_estimate),
        )
        self._looks.append((ctx.time_ns, look, snapshot))
        return self._finish(ctx)

    def on_goal(self, goal: Goal, ctx: Context) -> Finished | None:
        """Writes the remembered goal."""
        self._goals[goal.name] = goal
        _write(ctx.directory / f"goal-{goal.name}.pddl", goal.pddl)
        return self._finish(ctx)

    def on_plan(self, plan: Plan, ctx: Context) -> Finished | None:
        """Writes the planning problem and what the planner made of it."""
        self._plans.append(plan)
        number = f"{len(self._plans):02d}"
        _write(ctx.directory / "domain.pddl", plan.domain_pddl)
        _write(ctx.directory / f"problem-{number}.pddl", plan.problem_pddl)
        answer = "\n".join(plan.actions) if plan.status == "solved" else f"; {plan.status}: {plan.reason}"
        _write(ctx.directory / f"plan-{number}.txt", answer)
        return self._finish(ctx)

    def on_outcome(self, outcome: Outcome, ctx: Context) -> Finished | None:
        """Keeps how a transfer ended."""
        self._outcomes[outcome.number] = outcome
        return self._finish(ctx)

    def on_restarted(self, restarted: Restarted, ctx: Context) -> None:
        """Keeps what crashed and was replaced."""
        self._restarts.append(f"{restarted.stage} {restarted.replica} ({restarted.reason})")

    def on_verdict(self, verdict: Verdict, ctx: Context) -> Finished | None:
        """Ends the episode once everything that led to the verdict is here."""
        self._verdict = verdict
        return self._finish(ctx)

    def _finish(self, ctx: Context) -> Finished | None:
        verdict = self._verdict
        if verdict is None or not self._complete(verdict):
            return None
        episode = self._episode(verdict)
        text = plain(episode)
        _write(ctx.directory / "report.txt", text)
        _write(ctx.directory / "report.md", markdown(episode))
        ctx.log("\n" + text)
        good = verdict.success and not episode.judgement.false_success
        return Finished(code=0 if good else 1, reason=title(episode))

    def _episode(self, verdict: Verdict) -> Episode:
        looks = sorted(self._looks, key=lambda item: item[0])
        outcomes = tuple(self._outcomes[number] for number in sorted(self._outcomes))
        snapshots = [snapshot for *_, snapshot in looks]
        return Episode(
            verdict=verdict,
            looks=tuple(look for _, look, _ in looks),
            plans=tuple(self._plans),
            outcomes=outcomes,
            judgement=self._truth.judge(snapshots, self._goals.get(verdict.goal_name), verdict, outcomes),
            restarts=tuple(self._restarts),
        )

    def _complete(self, verdict: Verdict) -> bool:
        """Relations are compared with a goal, so it must have come too."""
        arrived = (len(self._looks), len(self._plans), len(self._outcomes))
        expected = (verdict.looks, verdict.plans, verdict.transfers)
        return arrived == expected and bool(self._goals or not (verdict.satisfied or verdict.violated))


def _write(path: Path, text: str) -> None:
    path.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
