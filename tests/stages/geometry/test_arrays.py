"""Equal rows, as numpy's own function finds them."""

import numpy as np
import pytest

from stages.geometry.arrays import distinct_rows


@pytest.mark.parametrize("kind", [np.int64, np.float64])
def test_rows_are_those_that_numpy_finds(kind: type):
    rows = np.random.default_rng(0).integers(-3, 4, (500, 3)).astype(kind)
    _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    found = distinct_rows(rows)
    np.testing.assert_array_equal(found[0], first)
    np.testing.assert_array_equal(found[1], which.reshape(-1))


def test_zeros_of_both_signs_are_equal():
    first, which = distinct_rows(np.array([[0.0, -0.0], [-0.0, 0.0], [-1.0, 0.0]]))
    assert (first.tolist(), which.tolist()) == ([2, 0], [1, 1, 0])
