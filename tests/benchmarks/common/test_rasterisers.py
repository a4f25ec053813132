"""What the kernel is timed beside computes what the kernel computes."""

import numpy as np
import pytest

from benchmarks.common.rasterisers import Task, edge_functions, pyrender_loop, torch_edges
from benchmarks.perception.kernel import CATALOGUE, SHAPES, problem
from stages.scene.catalogue import Catalogue
from tests.stages.perception import oracle


@pytest.mark.parametrize("make", [torch_edges, pyrender_loop])
def test_rivals_compute_the_same_costs(make) -> None:
    item = Catalogue.load(CATALOGUE)["mug"]
    likelihood, poses = problem(item, 160, 500)
    task = Task(item.simplified(500), likelihood.window, likelihood.form)
    expected = likelihood.costs(poses[:8]) - likelihood.base
    assert make(task)(poses[:8]) == pytest.approx(expected, abs=0.05 * likelihood.base)


def test_edge_functions_are_the_oracle() -> None:
    item = Catalogue.load(CATALOGUE)[SHAPES[0]]
    likelihood, poses = problem(item, 160, 500)
    mesh, view = item.simplified(100), likelihood.window.view
    exact = oracle.inverse_depth(mesh, poses[0], view)
    found = edge_functions(mesh, poses[:1], view)[0].numpy()
    both = (exact > 0) & (found > 0)
    assert ((exact > 0) != (found > 0)).sum() <= 2
    assert np.abs(found[both] / exact[both] - 1).max() < 1e-3
