"""Shared memory: what lies in it stays as it is while anybody refers to it, here or there, and not longer."""

import os
import random
from functools import partial

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from runner.transport.arena import ALIGNMENT, Block, Store, Window

SIZES = st.lists(st.integers(0, 5000), min_size=1, max_size=40)


def window_of(store: Store) -> Window:
    return Window(os.dup(store.descriptor(0)))


@given(SIZES, st.randoms(use_true_random=False))
def test_blocks_that_are_there_never_overlap(sizes: list[int], chance: random.Random):
    store, blocks, contents = Store(), list[Block](), list[bytes]()
    for size in sizes:
        contents.append(chance.randbytes(size))
        blocks.append(store.write([contents[-1][: size // 3], memoryview(contents[-1])[size // 3 :]]))
        if chance.random() < 0.4:
            victim = chance.randrange(len(blocks))
            del blocks[victim], contents[victim]
    assert [bytes(block.view) for block in blocks] == contents
    assert all(block.place.offset % ALIGNMENT == 0 for block in blocks)
    del blocks
    assert store.write([b"x"]).place.offset == 0
    store.close()


def test_a_block_stays_while_a_reader_has_an_array_on_it():
    store = Store()
    block = store.write([b"first"])
    store.lend(block)
    place, window = block.place, window_of(store)
    array = np.frombuffer(window.read(place.offset, place.size, partial(store.give_back, 0, place.offset)), np.uint8)
    view = array[1:4]
    del block, array
    second = store.write([b"other"])
    assert second.place.offset != place.offset
    assert view.tobytes() == b"irs" and not view.flags.writeable
    del view
    assert store.write([b"third"]).place.offset == place.offset
    store.close()


def test_a_large_message_gets_an_arena_of_its_own_and_small_ones_share():
    store = Store()
    small, other, large = store.write([b"a"]), store.write([b"b"]), store.write([bytes(2**28 + 1)])
    assert [block.place.arena for block in (small, other, large)] == [0, 0, 1]
    del large
    store.close()


def test_what_lies_outside_is_refused():
    store = Store()
    keep = store.write([b"a"])
    window = window_of(store)
    for offset, size in ((-1, 2), (0, 2**40), (2**28, 1), (2**63, 1), (5, -1)):
        try:
            window.read(offset, size, lambda: None)
        except ValueError as error:
            assert "not within" in str(error)
        else:
            raise AssertionError((offset, size))
    assert keep.place.size == 1
    store.close()
