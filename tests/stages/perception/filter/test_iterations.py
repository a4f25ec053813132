"""The schedule, and populations that evolve on the CPU; what a GPU makes of the same is in ``cuda/simulated.py``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.perception.filter.iterations import CPU, HostIterations, IterationSettings, Population, iterated, steps
from stages.perception.filter.particle_filter import ObjectFilter, Task, pixels, run_together
from stages.perception.filter.settings import FilterSettings
from tests.stages.perception.scenes import CATALOGUE, render, upright

SEEN = render({"mug": upright("mug", -0.05, 0.0, 0.6), "tea_box": upright("tea_box", 0.1, 0.06, 0.2)})
SETTINGS = FilterSettings(particles=50, fine_particles=20, schedule=8, dof=3)


def tasks(*labels: str) -> list[Task]:
    scene = SEEN.scene
    return [
        Task(ObjectFilter(CATALOGUE[label], SETTINGS), scene.plane_inverse, pixels(SEEN.boxes[label], scene),
             np.random.default_rng(len(label)))
        for label in labels
    ]  # fmt: skip


def population(settings: FilterSettings = SETTINGS) -> Population:
    """First guesses of the tea box in the first phase."""
    owner = ObjectFilter(CATALOGUE["tea_box"], settings)
    scene, box = SEEN.scene, pixels(SEEN.boxes["tea_box"], SEEN.scene)
    guess = owner.guess(scene, scene.plane_inverse, box)
    phase = owner.phases(scene, scene.plane_inverse, box, guess, 8)[0]
    rng = np.random.default_rng(4)
    poses = owner.proposals.initial(guess, settings.particles, rng)
    return Population(poses, phase.likelihood, phase.directions, owner.proposals, guess, rng)


def test_the_schedule_anneals_and_tapers() -> None:
    plan = steps(SETTINGS, 0.0, 0.5, 4) + steps(SETTINGS, 0.5, 1.0, 4)
    assert [step.count for step in plan] == [50, 45, 40, 35, 32, 28, 25, 22]
    for spreads, (first, last) in (
        ([step.metres for step in plan], SETTINGS.metres), ([step.radians for step in plan], SETTINGS.radians)
    ):  # fmt: skip
        assert np.diff(np.log(spreads)) == pytest.approx(np.log(last / first) / 8)
        assert spreads[0] == first
    assert plan[0] == IterationSettings(50, 0.03, SETTINGS.radians[0], flipped=3, renewed=2, polished=6)
    assert plan[-1].renewed == 0


def test_the_papers_form_neither_tapers_nor_polishes() -> None:
    settings = FilterSettings.paper()
    for step in steps(settings, 0.0, 1.0, 5):
        assert (step.count, step.flipped, step.renewed, step.polished) == (625, 0, 0, 0)
        assert (step.metres, step.radians) == pytest.approx((0.01, settings.radians[0]))


def test_iterations_in_parts_are_iterations_at_once() -> None:
    plan = steps(SETTINGS, 0.0, 0.5, 5)
    once, parts = (HostIterations([population()], plan, SETTINGS) for _ in range(2))
    assert not once.iterate(5)
    sizes = [len(parts.population()[0])]
    while parts.iterate(1):
        sizes.append(len(parts.population()[0]))
    assert sizes == [50, *(step.count for step in plan[:-1])]
    assert parts.population()[0].tobytes() == once.population()[0].tobytes()
    assert [generation.cost for generation in parts.history()[0]] == [g.cost for g in once.history()[0]]
    assert once.best()[0] == min(generation.cost for generation in once.history()[0])


def test_a_phase_without_progress_ends_early() -> None:
    settings = replace(SETTINGS, metres=(1e-6, 1e-6), radians=(1e-6, 1e-6), flips=0.0, renewed=0.0, patience=2)
    plan = steps(settings, 0.0, 0.5, 30)
    assert len(iterated([population(settings)], plan, settings, CPU).history()[0]) < 30
    patient = replace(settings, schedule=None)
    assert len(iterated([population(patient)], plan, patient, CPU).history()[0]) == 30


def test_objects_side_by_side_end_as_each_alone() -> None:
    together = run_together(SEEN.scene, tasks("mug", "tea_box"), iterations=8)
    alone = [run_together(SEEN.scene, [task], iterations=8)[0] for task in tasks("mug", "tea_box")]
    for one, other in zip(together, alone, strict=True):
        assert one.T_camera_object.tobytes() == other.T_camera_object.tobytes()
        assert one.positions.tobytes() == other.positions.tobytes()
        assert one.costs == other.costs
