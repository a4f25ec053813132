"""The CUDA kernels in numba's simulator, which runs every thread of a block as Python.

``test_cuda_kernels.py`` starts this module in a process of its own, because numba reads NUMBA_ENABLE_CUDASIM when it
is imported.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.cuda import exchanged, problem, resident
from stages.perception.cuda_batch import Batch, Launch, Look, change_of_cost_cuda
from stages.perception.cuda_filter import CudaFilter, Population, Schedule
from stages.perception.cuda_math import SIMULATED
from stages.perception.cuda_random import normals, philox
from stages.perception.evaluators import chosen_device
from stages.perception.kernels import IMPOSSIBLE
from stages.perception.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.poses import compose, exp_so3, log_so3, pose, rotate
from stages.perception.rasteriser import Soup, inverse_depth
from stages.scene.catalogue import Floats, Mesh
from tests.stages.perception import oracle
from tests.stages.perception.scenes import CATALOGUE, camera

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


def scene(*, seed: int = 0) -> ObservedScene:
    """A table with steps of up to 6 cm on it and a tenth of the readings missing."""
    blank = np.ones((HEIGHT, WIDTH), np.float32)
    plane = ObservedScene.of(blank, blank > 0, K, camera()).plane_inverse
    rng = np.random.default_rng(seed)
    depth = 1 / np.maximum(plane, 0.4) - np.repeat(rng.uniform(0, 0.06, (HEIGHT, 4)), 6, 1)
    depth = np.where(rng.random(depth.shape) < 0.1, 0, depth)
    return ObservedScene.of(depth.astype(np.float32), depth > 0.1, K, camera())


def holding(mesh: Mesh) -> ObservedScene:
    """A table and one object on it, without noise."""
    blank = np.ones((HEIGHT, WIDTH), np.float32)
    empty = ObservedScene.of(blank, blank > 0, K, camera())
    rendered = inverse_depth(Soup.of(mesh), standing(turn=(0.3, 0.4, 0.5)), empty.view)
    depth = 1 / np.maximum(np.maximum(empty.plane_inverse, rendered), 0.4)
    return ObservedScene.of(depth, rendered > empty.plane_inverse, K, camera())


def likelihood(mesh: Mesh, seen: ObservedScene, form: CostForm, box: tuple[int, int, int, int]) -> ObjectLikelihood:
    window = Window.of(seen, seen.plane_inverse, box, box, stride=1, form=form)
    return ObjectLikelihood(Shape.of(mesh), window, seen, form)


def look(cpu: ObjectLikelihood, seen: ObservedScene) -> Look:
    return Look(cpu.window, seen.plane, cpu.form)


def standing(*, x: float = 0.0, y: float = 0.0, turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Floats:
    """3 x 4 pose of an object whose origin is 8 cm above the table."""
    return (camera() @ pose(exp_so3(np.array(turn)), np.array([x, y, 0.08])))[:3]


def definition(cpu: ObjectLikelihood, mesh: Mesh, T: Floats, plane: Floats) -> float:
    """The change of cost from the exact rasteriser, pixel by pixel in float64."""
    window, form = cpu.window, cpu.form
    q = oracle.inverse_depth(mesh, T, window.view)
    shown = (q > window.inverse_background) & (window.factor > 0)
    behind = window.factor * (1 / np.where(shown, q, 1) - window.observed)
    cost = np.where(behind > form.occluder_margin, form.occluder_cost, np.minimum(abs(behind), form.truncation)
                    - window.credit)  # fmt: skip
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
@settings(max_examples=15, deadline=None)
def test_costs_are_the_cpu_kernels_and_the_oracles(poses: list[Floats], plain: bool, mug: bool) -> None:
    seen, mesh = scene(), MUG if mug else BOX
    cpu = likelihood(mesh, seen, CostForm.paper() if plain else CostForm(), (0, 0, WIDTH, HEIGHT))
    found = change_of_cost_cuda(Batch([cpu.shape], [look(cpu, seen)], SMALL), np.stack(poses))
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
    costs = change_of_cost_cuda(Batch([cpu.shape], [look(cpu, seen)], SMALL), poses)
    assert costs.tolist() == [IMPOSSIBLE, IMPOSSIBLE]


def test_one_launch_weighs_two_meshes_in_two_windows() -> None:
    first, second = scene(seed=1), scene(seed=2)
    a = likelihood(MUG, first, CostForm(), (2, 0, 20, 17))
    b = likelihood(BOX, second, CostForm().truncated(0.015), (4, 1, 24, 18))
    poses = np.stack([standing(x=x, turn=(0.3, 0.2, x)) for x in (-0.1, 0.0, 0.1, 0.05)])
    batch = Batch([a.shape, b.shape], [look(a, first), look(b, second)], SMALL)
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
    whole = change_of_cost_cuda(Batch([cpu.shape], [look(cpu, seen)], SMALL), poses)
    assert abs(whole).min() > 0.1
    for launch in (Launch(threads=8, z_buffer_bytes=4, team=1), Launch(threads=8, z_buffer_bytes=300, team=8)):
        batch = Batch([cpu.shape], [look(cpu, seen)], launch)
        assert change_of_cost_cuda(batch, poses).tobytes() == whole.tobytes()


def test_tensors_are_read_and_written_where_they_lie() -> None:
    seen = scene()
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    poses, out = torch.as_tensor(around(2), dtype=torch.float32), torch.zeros(2)
    which = torch.zeros(2, dtype=torch.int32)
    Batch([cpu.shape], [look(cpu, seen)], TINY).write_costs(poses, which, which, out)
    assert out.numpy() == pytest.approx(cpu.costs(poses.numpy()) - cpu.base, rel=1e-4, abs=0.01)


def population(cpu: ObjectLikelihood, poses: Floats, **changes: Any) -> Population:
    half_turn = exp_so3(np.array([[np.pi, 0.0, 0.0]]))
    default: dict[str, Any] = {"mesh": 0, "window": 0, "directions": np.eye(6), "flips": half_turn, "pool": poses[:1]}
    return Population(poses=poses, **(default | changes))


def still(**changes: Any) -> Schedule:
    """A schedule in which nothing moves but by resampling."""
    return replace(Schedule(rows=np.zeros((1, 3)), flipped=0.0, elitism=False), **changes)


def evolved(cpu: ObjectLikelihood, seen: ObservedScene, poses: Floats, schedule: Schedule, **changes: Any) -> Floats:
    """The second generation, N x 3 x 4."""
    batch = Batch([cpu.shape], [look(cpu, seen)], TINY)
    filters = CudaFilter([cpu.shape], [look(cpu, seen)], [population(cpu, poses, **changes)], schedule, seed=5,
                         batch=batch)  # fmt: skip
    filters.iterate(1)
    least = cpu.energies(poses.astype(np.float32)).min() - cpu.base
    assert filters.history()[0] == pytest.approx([least], rel=1e-3, abs=0.02)
    return filters.generation()[0]


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
    following = evolved(cpu, seen, poses, still(scale=2.0))
    energies = cpu.energies(poses)
    wished = count * np.exp(-2.0 * (energies - energies.min()))
    wished /= np.exp(-2.0 * (energies - energies.min())).sum()
    copies = np.array([(abs(following[:, :, 3] - T[:, 3]).max(1) < 1e-6).sum() for T in poses])
    assert copies.sum() == count
    assert abs(copies - wished).max() < 1.05


def test_the_scale_is_chosen_for_the_effective_sample_size() -> None:
    seen, count = scene(), 24
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    following = evolved(cpu, seen, around(count), still(effective=0.25))
    kept = np.unique(following[:, :, 3].round(6), axis=0, return_counts=True)[1]
    assert count**2 / (kept**2).sum() == pytest.approx(0.25 * count, abs=2.5)


def test_the_transition_diffuses_about_the_centre() -> None:
    seen, count = scene(), 32
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    T = standing(turn=(0.3, 0.4, 0.5))
    row = np.array([[0.004, 0.2, 0.0]])
    following = evolved(cpu, seen, np.repeat(T[None], count, 0), still(rows=row))
    shifts = rotate(following[:, :, :3], cpu.shape.centre) + following[:, :, 3] - T[:, :3] @ cpu.shape.centre - T[:, 3]
    assert shifts.std(0) == pytest.approx([0.004] * 3, rel=0.4)
    turns = log_so3(compose(following[:, :, :3], T[:, :3].T))
    assert turns.std(0) == pytest.approx([0.2] * 3, rel=0.4)
    assert compose(following[:, :, :3], np.swapaxes(following[:, :, :3], 1, 2)) == pytest.approx(
        np.broadcast_to(np.eye(3), (count, 3, 3)), abs=1e-5
    )


def test_upright_objects_stay_upright() -> None:
    seen = scene()
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    T, up = standing(), seen.T_camera_table[:3, 2]
    upright = np.zeros((6, 1))
    upright[:3, 0] = up
    following = evolved(cpu, seen, np.repeat(T[None], 12, 0), still(rows=np.array([[0.1, 0.5, 0.0]])),
                        directions=upright)  # fmt: skip
    assert following[:, :, 2] == pytest.approx(np.broadcast_to(up, (12, 3)), abs=1e-5)
    assert abs(following[:, :, 0] - T[:, 0]).max() > 0.1


def test_flips_spins_renewal_and_elitism() -> None:
    seen, count = scene(), 24
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    poses, fresh = around(count), around(5, metres=0.1)
    schedule = still(rows=np.array([[0.0, 0.0, 0.3]]), flipped=0.4, elitism=True)
    following = evolved(cpu, seen, poses, schedule, pool=fresh)
    R = poses[0, :, :3]
    turns = log_so3(compose(R.T, following[:, :, :3]))
    assert following[-1] == pytest.approx(poses[np.argmin(cpu.energies(poses))], abs=1e-6)
    renewed = (abs(following[:, None, :, 3] - fresh[None, :, :, 3]).max(-1) < 1e-6).any(1)
    flipped = abs(abs(turns[:, 0]) - np.pi) < 1e-3
    spun = ~flipped & (np.linalg.norm(turns, axis=1) > 1e-3)
    assert 4 <= renewed.sum() <= 20
    assert 3 <= flipped.sum() <= 16
    assert 3 <= spun.sum() <= 16
    assert ((abs(turns[spun]) > 1e-3).sum(1) == 1).all()


def test_populations_of_two_hypotheses_converge_side_by_side() -> None:
    """Two meshes in two windows: after some iterations each population is better, and equal seeds give equal bytes."""
    first, second = holding(BOTTLE), holding(BOX)
    a = likelihood(BOTTLE, first, CostForm(), (6, 4, 18, 13))
    b = likelihood(BOX, second, CostForm(), (4, 3, 16, 12))
    looks = [look(a, first), look(b, second)]
    schedule = replace(Schedule.annealed(3, metres=(0.02, 0.005), radians=(0.3, 0.05)), scale=3.0)

    def run() -> CudaFilter:
        batch = Batch([a.shape, b.shape], looks, TINY)
        populations = [population(a, around(8, metres=0.04)), population(b, around(8, metres=0.04), mesh=1, window=1)]
        filters = CudaFilter([a.shape, b.shape], looks, populations, schedule, seed=1, batch=batch)
        filters.iterate(3)
        return filters

    once, again = run(), run()
    history = once.history()
    assert history.shape == (2, 3)
    assert (np.diff(history) <= 0).all()
    assert (history[:, -1] < history[:, 0]).all()
    assert once.generation().tobytes() == again.generation().tobytes()


def test_the_benchmark_runs() -> None:
    cpu, poses = problem(CATALOGUE["tea_box"], 24, 12)
    assert exchanged(cpu, poses[:1], iterations=1, launch=TINY) > 0
    assert resident(cpu, poses[:1], copies=2, iterations=1, launch=TINY) > 0


def test_the_likelihood_takes_the_device() -> None:
    seen = scene()
    cpu = likelihood(BOX, seen, CostForm(), (6, 4, 18, 13))
    gpu = ObjectLikelihood(cpu.shape, cpu.window, seen, cpu.form, device=chosen_device("auto", place="device"))
    poses = around(2)
    assert gpu.energies(poses) == pytest.approx(cpu.energies(poses), rel=1e-4)
    assert gpu.energies(poses).dtype == np.float64
