from hypothesis import given
from hypothesis import strategies as st

from runner.recording.intervals import Intervals

NUMBERS = st.lists(st.integers(0, 40))
CHANGES = st.lists(st.tuples(st.booleans(), st.integers(0, 40)))


def intervals(numbers: list[int]) -> Intervals:
    made = Intervals()
    for number in numbers:
        made.add(number)
    return made


def numbers(of: Intervals) -> list[int]:
    return [number for start, stop in of for number in range(start, stop)]


@given(changes=CHANGES)
def test_holds_what_was_added_and_not_taken_out_in_as_few_ranges_as_can_be(changes: list[tuple[bool, int]]):
    made, expected = Intervals(), set[int]()
    for put_in, number in changes:
        (made.add if put_in else made.discard)(number)
        (expected.add if put_in else expected.discard)(number)
    assert numbers(made) == sorted(expected)
    assert [number in made for number in range(42)] == [number in expected for number in range(42)]
    assert len(made) == sum(number - 1 not in expected for number in expected)
    assert made.stop == max(expected, default=-1) + 1


@given(one=NUMBERS, other=NUMBERS)
def test_merges_and_subtracts_like_sets(one: list[int], other: list[int]):
    assert numbers(intervals(one) | intervals(other)) == sorted({*one, *other})
    assert numbers(intervals(one) - intervals(other)) == sorted({*one} - {*other})
    assert list(intervals(one) | intervals(other)) == list(intervals([*one, *other]))


@given(inside=NUMBERS, start=st.integers(0, 40), stop=st.integers(0, 40))
def test_gaps_are_what_is_not_there(inside: list[int], start: int, stop: int):
    gaps = Intervals(intervals(inside).gaps(start, stop))
    assert numbers(gaps) == sorted({*range(start, stop)} - {*inside})


@given(ranges=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40))))
def test_ranges_come_in_any_order_and_overlap(ranges: list[tuple[int, int]]):
    assert numbers(Intervals(ranges)) == sorted({number for start, stop in ranges for number in range(start, stop)})


def test_a_million_numbers_that_arrive_a_little_out_of_order_take_one_range():
    made = Intervals()
    for number in range(0, 1_000_000, 2):
        made.add(number + 1)
        made.add(number)
    assert list(made) == [(0, 1_000_000)]


def test_of_numbers_with_gaps_the_highest_are_kept():
    made = Intervals()
    for number in range(0, 1000, 2):
        made.add(number)
        made.keep(10)
    assert 10 <= len(made) <= 20 and 998 in made and 982 in made and 0 not in made
