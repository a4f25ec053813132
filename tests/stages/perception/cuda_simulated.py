"""The CUDA kernels in numba's simulator, which runs every thread of a block as Python.

``test_cuda_kernels.py`` starts this module in a process of its own, because numba reads NUMBA_ENABLE_CUDASIM when it
is imported.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.perception.cuda_batch import Batch, Launch, Look, change_of_cost_cuda
from stages.perception.cuda_math import SIMULATED
from stages.perception.kernels import IMPOSSIBLE
from stages.perception.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.poses import exp_so3, pose
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
SMALL = Launch(threads=8)


def scene(*, seed: int = 0) -> ObservedScene:
    """A table with steps of up to 6 cm on it and a tenth of the readings missing."""
    blank = np.ones((HEIGHT, WIDTH), np.float32)
    plane = ObservedScene.of(blank, blank > 0, K, camera()).plane_inverse
    rng = np.random.default_rng(seed)
    depth = 1 / np.maximum(plane, 0.4) - np.repeat(rng.uniform(0, 0.06, (HEIGHT, 4)), 6, 1)
    depth = np.where(rng.random(depth.shape) < 0.1, 0, depth)
    return ObservedScene.of(depth.astype(np.float32), depth > 0.1, K, camera())


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
