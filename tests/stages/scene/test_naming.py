"""Names of objects: unique in a scene, and kept from look to look by where things stand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.scene.naming import Named, best_exchange, exchanges, names_kept, unique_names


@pytest.mark.parametrize(
    ("labels", "names"),
    [
        (["cup", "cup", "cup"], ["cup", "cup_2", "cup_3"]),
        (["cup", "cup", "cup_2"], ["cup", "cup_3", "cup_2"]),
        (["cup_2", "cup", "cup_2", "cup"], ["cup_2", "cup", "cup_2_2", "cup_3"]),
    ],
)
def test_further_instances_take_the_next_free_number(labels: list[str], names: list[str]) -> None:
    assert unique_names(labels) == names


@given(st.lists(st.sampled_from(["cup", "cup_2", "cup_3", "cup_2_2", "box"])))
def test_names_are_unique_and_begin_with_the_label(labels: list[str]) -> None:
    names = unique_names(labels)
    assert len(set(names)) == len(names)
    assert all(name.startswith(label) for name, label in zip(names, labels, strict=True))


def known(**places: float) -> dict[str, Named]:
    return {name: Named("cup", np.array([x, 0.0, 0.0])) for name, x in places.items()}


def at(*xs: float) -> np.ndarray:
    return np.array([[x, 0.0, 0.0] for x in xs]).reshape(-1, 3)


def test_what_stands_where_it_stood_keeps_its_name_whatever_the_order() -> None:
    before = known(cup=0.0, cup_2=0.3)
    assert unique_names(["cup", "cup"], names_kept(["cup", "cup"], at(0.31, -0.01), before)) == ["cup_2", "cup"]


def test_what_was_moved_takes_the_name_that_is_left() -> None:
    before = known(cup=0.0, cup_2=0.3)
    assert unique_names(["cup", "cup"], names_kept(["cup", "cup"], at(0.8, 0.3), before)) == ["cup", "cup_2"]
    assert unique_names(["cup", "cup"], names_kept(["cup", "cup"], at(0.8, 0.0), before)) == ["cup_2", "cup"]


def test_the_one_that_is_still_seen_keeps_its_name() -> None:
    assert unique_names(["cup"], names_kept(["cup"], at(0.29), known(cup=0.0, cup_2=0.3))) == ["cup_2"]


def test_places_of_other_labels_mean_nothing() -> None:
    assert names_kept(["bowl"], at(0.0), known(cup=0.0)) == [None]


def test_equal_objects_are_exchanged_in_every_way() -> None:
    labels, names = ["cup", "bowl", "cup"], ["cup", "bowl", "cup_2"]
    assert list(exchanges(labels, names, {})) == [["cup", "bowl", "cup_2"], ["cup_2", "bowl", "cup"]]


def test_what_is_exchanged_takes_the_names_that_are_wanted_first() -> None:
    wanted = {"cup": "cup", "cup_3": "cup", "bowl_2": "bowl"}
    assert list(exchanges(["cup"], ["cup_2"], wanted)) == [["cup"], ["cup_3"]]
    three = list(exchanges(["cup"] * 3, ["cup_2", "cup", "cup_5"], wanted))
    assert len(three) == 6 and {frozenset(names) for names in three} == {frozenset({"cup", "cup_3", "cup_2"})}


def test_the_best_exchange_is_the_one_whose_objects_are_worth_most() -> None:
    labels, names = ["cup", "bowl", "cup", "cup"], ["cup", "bowl", "cup_2", "cup_3"]
    wanted = {"cup": "cup", "cup_2": "cup"}
    worths = {(0, "cup"): 2.0, (2, "cup"): 3.0, (0, "cup_2"): 1.0, (2, "cup_2"): 3.0}
    best = best_exchange(labels, names, wanted, lambda i, name: worths.get((i, name), 0.0))
    assert best == ["cup", "bowl", "cup_2", "cup_3"]
    worths[0, "cup_2"] = 4.0
    assert best_exchange(labels, names, wanted, lambda i, name: worths.get((i, name), 0.0))[:3] == [
        "cup_2",
        "bowl",
        "cup",
    ]
