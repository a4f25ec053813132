"""The CUDA kernels in numba's simulator, which runs every thread of a block as Python.

``test_kernels.py`` starts this module in a process of its own, because numba reads NUMBA_ENABLE_CUDASIM when it
is imported.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.perception.cuda import deviation, exchanged, problem, resident
from stages.geometry.arrays import Floats
from stages.geometry.poses import compose, exp_so3, log_so3, pose, rotate
from stages.perception.cuda.batch import Batch, CostInputs, Launch
from stages.perception.cuda.cost_kernel import block_sum
from stages.perception.cuda.device import chosen_device
from stages.perception.cuda.iterations import CudaIterations
from stages.perception.cuda.polish_kernel import refine
from stages.perception.cuda.random_numbers import normals, philox
from stages.perception.cuda.scalars import SIMULATED
from stages.perception.cuda.transition_kernel import evolve
from stages.perception.filter.iterations import THINNED, HostIterations, IterationSettings, Population
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.filter.particle_filter import ObjectFilter, Task, Track, run_together
from stages.perception.filter.proposals import Dof, Guess, Proposals
from stages.perception.filter.settings import FilterSettings
from stages.perception.rendering.kernels import IMPOSSIBLE
from stages.perception.rendering.rasteriser import Soup, inverse_depth
from stages.scene.catalogue import Mesh
from stages.scene.metrics import pose_errors
from tests.stages.perception import oracle
from tests.stages.perception.scenes import CATALOGUE, camera, upright

pytestmark = [
    pytest.mark.skipif(not SIMULATED, reason="NUMBA_ENABLE_CUDASIM is not set"),
    # A triangle without area divides by zero and is culled; only Python warns of that.
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
]

WIDTH, HEIGHT = 24, 18
K = np.array([[70.0, 0.0, 11.3], [0.0, 70.0, 8.6], [0.0, 0.0, 1.0]])
MUG, BOX = CATALOGUE["mug"].simplified(60), CATALOGUE["cereal_box"].simplified(12)
BOTTLE = CATALOGUE["sauce_bottle"].simplified(24)
SMALL, TINY = Launch(threads=8), Launch(threads=2)


@pytest.fixture(scope="module", autouse=True)
def _simulator() -> Iterator[None]:
    """Threads that meet at barriers, quickly, and under whose feet nothing changes.

    The simulator puts itself in the place of ``cuda`` in a device function's module while one thread is in it, and
    takes itself out again while others still are: here it stays in all modules for the whole of a launch. Between
    barriers it polls, each time for a whole interval of the interpreter.
    """
    from numba.cuda.simulator import kernel

    simulator: Any = kernel
    swapped, interval = simulator.swapped_cuda_module, sys.getswitchinterval()

    @contextmanager
    def in_all_modules(function: Any, module: Any) -> Iterator[None]:
        with ExitStack() as stack:
            for each in (function, block_sum.fn, evolve.fn, refine.fn):
                # A first warning adds this name to the function's globals, while another thread reads all of them.
                each.__globals__.setdefault("__warningregistry__", {})
                stack.enter_context(swapped(each, module))
            yield

    sys.setswitchinterval(1e-5)
    simulator.swapped_cuda_module = in_all_modules
    yield
    simulator.swapped_cuda_module = swapped
    sys.setswitchinterval(interval)


def scene(*, seed: int = 0) -> ObservedScene:
    """A table with steps of up to 6 cm on it and a tenth of the readings missing."""
    blank = np.ones((HEIGHT, WIDTH), np.float32)
    plane = ObservedScene.of(blank, blank > 0, K, camera()).plane_inverse
    rng = np.random.default_rng(seed)
    depth = 1 / np.maximum(plane, 0.4) - np.repeat(rng.uniform(0, 0.06, (HEIGHT, 4)), 6, 1)
    depth = np.where(rng.random(depth.shape) < 0.1, 0, depth)
    return ObservedScene.of(depth.astype(np.float32), depth > 0.1, K, camera())


def holding(mesh: Mesh, T: Floats | None = None) -> ObservedScene:
    """A table and one object on it, without noise."""
    blank = np.ones((HEIGHT, WIDTH), np.float32)
    empty = ObservedScene.of(blank, blank > 0, K, camera())
    rendered = inverse_depth(Soup.of(mesh), standing(turn=(0.3, 0.4, 0.5)) if T is None else T, empty.view)
    depth = 1 / np.maximum(np.maximum(empty.plane_inverse, rendered), 0.4)
    return ObservedScene.of(depth, rendered > empty.plane_inverse, K, camera())


def likelihood(mesh: Mesh, seen: ObservedScene, form: CostForm, box: tuple[int, int, int, int]) -> ObjectLikelihood:
    window = Window.of(seen, seen.plane_inverse, box, box, stride=1, form=form)
    return ObjectLikelihood(Shape.of(mesh), window, seen, form)


def cost_inputs(cpu: ObjectLikelihood, seen: ObservedScene) -> CostInputs:
    return CostInputs(cpu.window, seen.plane, cpu.form)


def standing(*, x: float = 0.0, y: float = 0.0, turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Floats:
    """3 x 4 pose of an object whose origin is 8 cm above the table."""
    return (camera() @ pose(exp_so3(np.array(turn)), np.array([x, y, 0.08])))[:3]


def definition(cpu: ObjectLikelihood, mesh: Mesh, T: Floats, plane: Floats) -> float:
    """The change of cost from the exact rasteriser, pixel by pixel in float64."""
    window, form = cpu.window, cpu.form
    q = oracle.inverse_depth(mesh, T, window.view)
    shown = (q > window.inverse_background) & (window.factor > 0)
    behind = window.factor * (1 / np.where(shown, q, 1) - window.observed)
    distance = np.minimum(abs(behind), form.truncation)
    free = np.maximum(-window.credit, 0)
    explained = np.maximum(distance - free, 0) - np.maximum(window.credit, 0)
    cost = np.where(behind > form.occluder_margin, form.occluder_cost, explained)
    heights = (mesh.vertices @ T[:3, :3].T + T[:3, 3]) @ plane[:3] + plane[3]
    sunk = max(0.0, -heights.min() - form.contact_slack) * window.factor.size
    return float(cost[shown].sum() + sunk)


ANY_POSE = st.builds(
    lambda turn, shift: np.column_stack([exp_so3(np.array(turn)), shift]),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    # From behind the camera to beyond the table, and out of the picture on all sides.
    shift=st.tuples(st.floats(-0.25, 0.25), st.floats(-0.2, 0.2), st.floats(-0.1, 1.2)),
)


@given(poses=st.lists(ANY_POSE, min_size=3, max_size=3), plain=st.booleans(), mug=st.booleans())
@settings(max_examples=15)
def test_costs_are_the_cpu_kernels_and_the_oracles(poses: list[Floats], plain: bool, mug: bool) -> None:
    seen, mesh = scene(), MUG if mug else BOX
    cpu = likelihood(mesh, seen, CostForm.paper() if plain else CostForm(), (0, 0, WIDTH, HEIGHT))
    found = Batch([cpu.shape], [cost_inputs(cpu, seen)], SMALL).changes(np.stack(poses))
    expected = cpu.costs(np.stack(poses)) - cpu.base
    # A pixel centre within rounding of an edge may fall on either side of it: at most one or two in such a picture.
    pixel = 2.0 if plain else 0.08
    assert found == pytest.approx(expected, rel=1e-4, abs=pixel)
    for T, cost in zip(poses, found, strict=True):
        if cost != np.float32(IMPOSSIBLE):
            assert cost == pytest.approx(definition(cpu, mesh, T, seen.plane), rel=1e-3, abs=pixel)


def test_what_reaches_into_the_camera_is_impossible() -> None:
    seen = scene()
    cpu = likelihood(MUG, seen, CostForm(), (0, 0, WIDTH, HEIGHT))
    poses = np.stack([np.column_stack([np.eye(3), [0.0, 0.0, z]]) for z in (0.02, -1.0)])
    costs = Batch([cpu.shape], [cost_inputs(cpu, seen)], SMALL).changes(poses)
    assert costs.tolist() == [IMPOSSIBLE, IMPOSSIBLE]


def test_one_launch_weighs_two_meshes_in_two_windows() -> None:
    first, second = scene(seed=1), scene(seed=2)
    a = likelihood(MUG, first, CostForm(), (2, 0, 20, 17))
    b = likelihood(BOX, second, CostForm().truncated(0.015), (4, 1, 24, 18))
    poses = np.stack([standing(x=x, turn=(0.3, 0.2, x)) for x in (-0.1, 0.0, 0.1, 0.05)])
    batch = Batch([a.shape, b.shape], [cost_inputs(a, first), cost_inputs(b, second)], SMALL)
    found = batch.costs(poses, [0, 1, 1, 0], [0, 1, 0, 1])
    crossed = [ObjectLikelihood(s.shape, w.window, seen, w.form) for s, w, seen in
               ((a, a, first), (b, b, second), (b, a, first), (a, b, second))]  # fmt: skip
    expected = [c.costs(T[None])[0] - c.base for c, T in zip(crossed, poses, strict=True)]
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-3)
    assert batch.bases == pytest.approx([a.base, b.base])


def test_bands_and_teams_change_no_byte() -> None:
    seen = scene()
    cpu = likelihood(MUG, seen, CostForm(), (0, 0, WIDTH, HEIGHT))
    poses = np.stack([standing(turn=(0.4, 1.0, 2.0)), standing(x=0.1, turn=(2.0, 0.1, 0.0))])
    whole = Batch([cpu.shape], [cost_inputs(cpu, seen)], SMALL).changes(poses)
    assert abs(whole).min() > 0.1
    for launch in (Launch(threads=8, z_buffer_bytes=4, team=1), Launch(threads=8, z_buffer_bytes=300, team=8)):
        batch = Batch([cpu.shape], [cost_inputs(cpu, seen)], launch)
        assert batch.changes(poses).tobytes() == whole.tobytes()


def test_tensors_are_read_and_written_where_they_lie() -> None:
    seen = scene()
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    poses, out = torch.as_tensor(around(2), dtype=torch.float32), torch.zeros(2)
    which = torch.zeros(2, dtype=torch.int32)
    Batch([cpu.shape], [cost_inputs(cpu, seen)], TINY).write_costs(poses, which, which, out)
    assert out.numpy() == pytest.approx(cpu.costs(poses.numpy()) - cpu.base, rel=1e-4, abs=0.01)


def population(
    cpu: ObjectLikelihood, poses: Floats, label: str = "cereal_box", *, seed: int = 5, dof: Dof = 6
) -> Population:
    """Particles of an object; what is drawn anew comes from a reading in the middle of the picture."""
    proposals = Proposals(CATALOGUE[label], dof)
    guess = Guess(np.array([[0.0, 0.0, 0.7]]), camera())
    return Population(poses, cpu, proposals.directions(camera()), proposals, guess, np.random.default_rng(seed))


def step(count: int, **changes: Any) -> IterationSettings:
    """An iteration in which nothing moves but by resampling."""
    return replace(IterationSettings(count, 0.0, 0.0, flipped=0, renewed=0, polished=0), **changes)


def settings_of(**changes: Any) -> FilterSettings:
    return replace(FilterSettings(elitism=False), **changes)


def iterated(cpu: ObjectLikelihood, poses: Floats, plan: IterationSettings, *, dof: Dof = 6, **changes: Any) -> Floats:
    """The second generation, N x 3 x 4."""
    iterations = CudaIterations([population(cpu, poses, dof=dof)], [plan], settings_of(**changes), launch=TINY)
    assert not iterations.iterate(4)
    kept = iterations.history()[0][0]
    assert kept.cost == pytest.approx(cpu.energies(poses.astype(np.float32)).min(), rel=1e-3, abs=0.02)
    assert kept.positions == pytest.approx(poses[::THINNED, :, 3], abs=1e-6)
    return iterations.population()[0]


def around(count: int, *, metres: float = 0.02) -> Floats:
    rng = np.random.default_rng(3)
    poses = np.repeat(standing(turn=(0.3, 0.4, 0.5))[None], count, 0)
    poses[:, :, 3] += rng.normal(0, metres, (count, 3))
    return poses


def test_random_numbers_are_philoxs() -> None:
    """Known answers of the authors' Random123."""
    word = np.uint64(0xFFFFFFFF)
    nothing, everything = philox(*[np.uint64(0)] * 6), philox(*[word] * 6)
    assert [hex(x) for x in nothing] == ["0x6627e8d5", "0xe169c58d", "0xbc57ac4c", "0x9b00dbd8"]
    assert [hex(x) for x in everything] == ["0x408f276d", "0x41c83b0e", "0xa20bc7c6", "0x6d5451fd"]


def test_normal_numbers_are_normal() -> None:
    drawn = np.array([normals(i, 3, 1, 2, 7) for i in range(400)]).ravel()
    assert abs(drawn.mean()) < 0.1
    assert drawn.std() == pytest.approx(1, abs=0.08)
    assert abs(np.corrcoef(drawn[::2], drawn[1::2])[0, 1]) < 0.15


def test_resampling_is_systematic_by_the_weights() -> None:
    seen, count = scene(), 24
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    poses = around(count)
    following = iterated(cpu, poses, step(count), lambda_r=2.0)
    energies = cpu.energies(poses)
    wished = count * np.exp(-2.0 * (energies - energies.min()))
    wished /= np.exp(-2.0 * (energies - energies.min())).sum()
    copies = np.array([(abs(following[:, :, 3] - T[:, 3]).max(1) < 1e-6).sum() for T in poses])
    assert copies.sum() == count
    assert abs(copies - wished).max() < 1.05


def test_the_scale_is_chosen_for_the_effective_sample_size() -> None:
    seen, count = scene(), 24
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    following = iterated(cpu, around(count), step(count), effective=0.25)
    kept = np.unique(following[:, :, 3].round(6), axis=0, return_counts=True)[1]
    assert count**2 / (kept**2).sum() == pytest.approx(0.25 * count, abs=2.5)


def test_fewer_particles_follow() -> None:
    seen = scene()
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    poses, plan = around(24), [step(15), step(15), step(9)]
    iterations = CudaIterations([population(cpu, poses)], plan, settings_of(), launch=TINY)
    sizes = [len(iterations.population()[0])]
    while iterations.iterate(1):
        sizes.append(len(iterations.population()[0]))
    assert [*sizes, len(iterations.population()[0])] == [24, 15, 15, 9]
    alive = (iterations.population()[0][:, None, :, 3] == poses[None, :, :, 3].astype(np.float32)).all(-1)
    assert alive.any(1).all()


def test_the_transition_diffuses_about_the_centre() -> None:
    seen, count = scene(), 32
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    T = standing(turn=(0.3, 0.4, 0.5))
    following = iterated(cpu, np.repeat(T[None], count, 0), step(count, metres=0.004, radians=0.2))
    shifts = rotate(following[:, :, :3], cpu.shape.centre) + following[:, :, 3] - T[:, :3] @ cpu.shape.centre - T[:, 3]
    assert shifts.std(0) == pytest.approx([0.004] * 3, rel=0.4)
    turns = log_so3(compose(following[:, :, :3], T[:, :3].T))
    assert turns.std(0) == pytest.approx([0.2] * 3, rel=0.4)
    assert compose(following[:, :, :3], np.swapaxes(following[:, :, :3], 1, 2)) == pytest.approx(
        np.broadcast_to(np.eye(3), (count, 3, 3)), abs=1e-5
    )


@pytest.mark.parametrize("flipped", [0, 12])
def test_upright_objects_stay_upright(flipped: int) -> None:
    seen = scene()
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    T, up = standing(), seen.T_camera_table[:3, 2]
    plan = step(12, metres=0.0, radians=0.0 if flipped else 0.5, flipped=flipped)
    following = iterated(cpu, np.repeat(T[None], 12, 0), plan, dof=3)
    assert following[:, :, 2] == pytest.approx(np.broadcast_to(up, (12, 3)), abs=1e-5)
    assert abs(following[:, :, 0] - T[:, 0]).max() > 0.1
    if flipped:
        turns = np.rad2deg(log_so3(compose(T[:, :3].T, following[:, :, :3]))[:, 2]) / 30
        assert turns == pytest.approx(turns.round(), abs=1e-3) and (abs(turns) > 0.5).all()


def test_flips_spins_renewal_and_elitism() -> None:
    """Every particle has its place: flipped first (every second one spun), then diffused, renewed, and the best."""
    seen, count = scene(), 24
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    poses = around(count)
    following = iterated(cpu, poses, step(count, flipped=10, renewed=6), elitism=True)
    drawn = population(cpu, poses)
    fresh = drawn.proposals.initial(drawn.guess, 6, drawn.rng)
    assert following[18:23] == pytest.approx(fresh[:5], abs=1e-6)
    assert following[23] == pytest.approx(poses[np.argmin(cpu.energies(poses))], abs=1e-6)
    assert following[10:18, :, :3] == pytest.approx(np.repeat(poses[:1, :, :3], 8, 0), abs=1e-6)
    turns = compose(poses[0, :, :3].T, following[:10, :, :3])
    known = abs(turns[::2, None] - drawn.proposals.flips[None]).max((2, 3)).min(1)
    assert known == pytest.approx(0, abs=1e-5)
    spun = log_so3(turns[1::2]) @ drawn.proposals.axes
    assert ((abs(spun) > 1e-3).sum(1) == 1).all()
    centres = rotate(following[:10, :, :3], cpu.shape.centre) + following[:10, :, 3]
    before = poses[:, :, :3] @ cpu.shape.centre + poses[:, :, 3]
    assert abs(centres[:, None] - before[None]).max(-1).min(1) == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("dof", [3, 6])
def test_polish_is_the_cpus(dof: Dof) -> None:
    seen, rng = holding(BOX), np.random.default_rng(dof)
    cpu = likelihood(BOX, seen, CostForm(), (0, 0, WIDTH, HEIGHT))
    turns = np.array([0.3, 0.4, 0.5]) + rng.uniform(-0.15, 0.15, (4, 3))
    poses = np.stack([*(standing(turn=tuple(turn)) for turn in turns), standing(x=3.0)])
    poses[:4, :, 3] += rng.uniform(-0.01, 0.01, (4, 3))
    directions = Proposals(CATALOGUE["cereal_box"], dof).directions(camera())
    expected = cpu.refine(poses, directions, steps=2, gate=0.03)
    assert (abs(expected - poses).max((1, 2))[:4] > 1e-3).all()
    # The last is out of the picture and has nothing to go by.
    assert expected[4] == pytest.approx(poses[4])
    for launch in (TINY, Launch(threads=4, z_buffer_bytes=4)):
        found = Batch([cpu.shape], [cost_inputs(cpu, seen)], launch).refined(poses, directions, steps=2, gate=0.03)
        assert found == pytest.approx(expected, abs=1e-5)


def test_the_first_particles_are_polished() -> None:
    seen = holding(BOX)
    cpu = likelihood(BOX, seen, CostForm(), (0, 0, WIDTH, HEIGHT))
    poses = np.repeat(standing(x=0.004, turn=(0.33, 0.4, 0.5))[None], 6, 0)
    following = iterated(cpu, poses, step(6, polished=2))
    moved = cpu.refine(poses[:1], np.eye(6), steps=2, gate=0.03)[0]
    assert abs(moved - poses[0]).max() > 2e-3
    assert following[:2] == pytest.approx(np.stack([moved, moved]), abs=1e-5)
    assert following[2:] == pytest.approx(poses[2:], abs=1e-6)


ANNEALED = [step(8, metres=m, radians=r, flipped=1, polished=1, renewed=1)
            for m, r in ((0.02, 0.3), (0.01, 0.15), (0.005, 0.05))]  # fmt: skip


def two_hypotheses() -> list[Population]:
    """Two meshes in two windows, of different numbers of particles."""
    a = likelihood(BOTTLE, holding(BOTTLE), CostForm(), (6, 4, 18, 13))
    b = likelihood(BOX, holding(BOX), CostForm(), (4, 3, 16, 12))
    return [population(a, around(8, metres=0.04), "sauce_bottle", seed=1),
            population(b, around(6, metres=0.04), "cereal_box", seed=2)]  # fmt: skip


def test_hypotheses_in_one_batch_end_as_each_alone() -> None:
    chosen = settings_of(elitism=True, lambda_r=3.0)
    together = CudaIterations(two_hypotheses(), ANNEALED, chosen, launch=TINY)
    while together.iterate(2):
        pass
    for h in range(2):
        alone = CudaIterations([two_hypotheses()[h]], ANNEALED, chosen, launch=TINY)
        alone.iterate(3)
        assert together.population()[h].tobytes() == alone.population()[0].tobytes()
        costs = [generation.cost for generation in together.history()[h]]
        assert costs == [generation.cost for generation in alone.history()[0]]
        assert (np.diff(costs) <= 0).all() and costs[-1] < costs[0]
        assert together.best()[h] == costs[-1]


def test_a_population_that_settles_waits_for_the_others() -> None:
    """The box stands where it belongs and cannot improve; the bottle is far from it."""
    b = likelihood(BOX, holding(BOX), CostForm(), (4, 3, 16, 12))
    still = population(b, np.repeat(standing(turn=(0.3, 0.4, 0.5))[None], 4, 0))
    plan = [step(4), step(4), step(4), step(4, metres=0.05), step(4, metres=0.05)]
    iterations = CudaIterations([still, two_hypotheses()[0]], plan, settings_of(patience=2), launch=TINY)
    assert iterations.iterate(4)
    settled = iterations.population()[0]
    assert not iterations.iterate(4)
    assert [len(each) for each in iterations.history()] == [3, 5]
    assert iterations.population()[0].tobytes() == settled.tobytes()
    host = HostIterations([still], plan, settings_of(patience=2))
    assert not host.iterate(4)
    assert len(host.history()[0]) == 3


def test_whole_filters_land_where_the_cpus_do() -> None:
    """A box that stands, from first guesses to its pose, with tapering, early stop and polish.

    In one batch with another population it ends with the bytes that it has alone.
    """
    box = replace(CATALOGUE["cereal_box"], mesh=BOX)
    chosen = FilterSettings(particles=26, fine_particles=8, overdraw=2, schedule=6, patience=2, coarse_pixels=7.0,
                            fine_pixels=10.0, flips=0.1, polished=0.1, dof=3)  # fmt: skip
    seen = holding(BOX, (camera() @ upright("cereal_box", 0.0, 0.02, 0.5))[:3])

    def tracks(device: str, *seeds: int) -> list[Track]:
        owner = ObjectFilter(box, chosen, device=chosen_device(device, place="device"))
        tasks = [Task(owner, seen.plane_inverse, (4, 2, 19, 15), np.random.default_rng(seed)) for seed in seeds]
        return run_together(seen, tasks, iterations=6)

    (cpu,), (gpu,), (again, other) = tracks("cpu", 3), tracks("cuda", 3), tracks("cuda", 3, 4)
    for track in (gpu, other):
        errors = pose_errors(*(np.vstack([t.T_camera_object, [0, 0, 0, 1]]) for t in (track, cpu)),
                             box.symmetries.transforms())  # fmt: skip
        assert errors[0] < 0.01 and np.rad2deg(errors[1]) < 10
        assert track.cost < 1.1 * cpu.cost + 0.01
    assert again.T_camera_object.tobytes() == gpu.T_camera_object.tobytes()
    assert again.positions.tobytes() == gpu.positions.tobytes()
    assert other.positions.tobytes() != gpu.positions.tobytes()
    sizes = np.unique(gpu.positions[:, 0], return_counts=True)[1]
    assert sizes[0] == 2 and sizes[-1] == 1


def test_the_benchmark_runs() -> None:
    cpu, poses = problem(CATALOGUE["tea_box"], 24, 12)
    assert exchanged(cpu, poses[:1], iterations=1, launch=TINY) > 0
    assert resident(CATALOGUE["tea_box"], cpu, poses[:1], copies=2, iterations=1, launch=TINY) > 0
    assert deviation(cpu, poses[:2]) < 1e-3


def test_the_likelihood_takes_the_device() -> None:
    seen = scene()
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    device = chosen_device("auto", place="device")
    gpu = ObjectLikelihood(cpu.shape, cpu.window, seen, cpu.form, evaluator=device.evaluator)
    poses = around(2)
    assert gpu.energies(poses) == pytest.approx(cpu.energies(poses), rel=1e-4)
    assert gpu.energies(poses).dtype == np.float64
