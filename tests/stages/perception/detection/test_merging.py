"""Pieces of an image grow into objects: their boxes, sizes and outlines, worked out by hand."""

import numpy as np
import pytest

from stages.perception.detection.merging import Pieces, components, merged

Z = np.full((40, 60), 1.0)
Z[10:30, 10:20] = Z[10:30, 20:30] = 0.5
NONE = np.zeros(Z.shape, bool)


def labels() -> np.ndarray:
    """A ground (1) with two halves of one object (2, 3) and nothing at the right."""
    found = np.ones(Z.shape, np.int32)
    found[10:30, 10:20], found[10:30, 20:30] = 2, 3
    found[:, 50:] = 0
    return found


def values(left: float = 50.0, right: float = 50.0) -> np.ndarray:
    """Colour, point and normal of every pixel; the halves may differ in lightness."""
    result = np.zeros((*Z.shape, 9))
    result[..., 0] = 50
    result[10:30, 10:20, 0], result[10:30, 20:30, 0] = left, right
    result[..., 5], result[..., 8] = Z, -1
    return result


def members(pieces: Pieces) -> list[list[int]]:
    return [sorted(each.tolist()) for each in pieces.members]


def test_components_have_boxes_sizes_depths_and_what_of_their_outline_is_an_edge() -> None:
    edges = np.zeros(Z.shape, bool)
    edges[8:32, 18:22] = True
    found = components(labels(), Z, edges, NONE)
    assert found.whole and members(found) == [[1], [2], [3]]
    np.testing.assert_array_equal(found.boxes[1:], [[10, 10, 20, 30], [20, 10, 30, 30]])
    assert found.pixels.tolist() == [50 * 40 - 400, 200, 200]
    assert found.depth.tolist() == pytest.approx([1.0, 0.5, 0.5])
    assert 0.3 < found.outline[1, 0] < 0.5 and (found.outline[:, 1] == 0).all()


def test_who_is_nearer_hides_who_is_behind() -> None:
    found = components(labels(), Z, NONE, NONE)
    assert found.outline[0, 2] > 0.5
    assert found.outline[1, 2] == found.outline[2, 2] == 0


def test_the_halves_of_an_object_join_before_either_joins_the_ground() -> None:
    for pieces in merged(labels(), values(), NONE, NONE):
        assert not pieces.whole
        assert [2, 3] in members(pieces)
        whole = members(pieces).index([2, 3])
        np.testing.assert_array_equal(pieces.boxes[whole], [10, 10, 30, 30])
        assert pieces.pixels[whole] == 400 and pieces.depth[whole] == pytest.approx(0.5)
        assert members(pieces)[-1] == [1, 2, 3]


def test_the_outline_of_what_joined_is_that_of_the_whole() -> None:
    edges = np.zeros(Z.shape, bool)
    edges[8:32, 8:32] = True
    edges[12:28, 12:28] = False
    both = labels()
    both[both == 3] = 2
    expected = components(both, Z, edges, NONE).outline[1]
    for pieces in merged(labels(), values(), edges, NONE):
        np.testing.assert_allclose(pieces.outline[members(pieces).index([2, 3])], expected)


def test_colour_decides_only_where_it_is_asked() -> None:
    by_color, by_depth = merged(labels(), values(right=500.0), NONE, NONE)[2:]
    assert [1, 2] in members(by_color) and [2, 3] not in members(by_color)
    assert [2, 3] in members(by_depth)
