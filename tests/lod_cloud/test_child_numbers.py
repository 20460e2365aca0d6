"""Guesses of child numbers: right at the knots, the same on both sides, never far."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lod_cloud.build import BuildOptions, build_tree
from lod_cloud.child_numbers import ChildNumbers
from lod_cloud.columns import ColumnReader
from lod_cloud.protocol import RemoteProtocolError
from tests.lod_cloud.trees import random_scene


@given(st.integers(1, 300), st.integers(0, 99), st.sampled_from([1.0, 0.5]))
@settings(max_examples=20)
def test_guesses_are_near_and_the_same_after_transport(count: int, seed: int, ratio: float) -> None:
    tree = build_tree(random_scene(count, seed), options=BuildOptions(fan_out_ratio=ratio))
    numbers = ChildNumbers.of(tree)
    reader = ColumnReader(numbers.to_bytes())
    again = ChildNumbers.read(reader)
    reader.finish()
    inner = np.flatnonzero(tree.child_count).astype(np.int32)
    every = np.arange(len(tree), dtype=np.int32)
    firsts = numbers.first_children(inner)
    assert np.array_equal(firsts, again.first_children(inner))
    assert np.array_equal(numbers.parents(every), again.parents(every))
    assert (np.diff(firsts) >= 0).all()
    spacing = len(tree) / (len(numbers.knots) - 1)
    most = int(tree.child_count.max())
    assert np.abs(firsts - tree.first_child[inner]).max(initial=0) <= spacing * most + 1
    assert numbers.first_children(np.zeros(1, np.int32))[0] == numbers.knots[0]


def test_nonsense_is_refused() -> None:
    right = ChildNumbers(100, np.array([1, 40, 100]))
    assert ChildNumbers.read(ColumnReader(right.to_bytes())).nodes == 100
    with pytest.raises(RemoteProtocolError, match="last knot must be 100, not 99"):
        ChildNumbers.read(ColumnReader(ChildNumbers(100, np.array([1, 99])).to_bytes()))
    with pytest.raises(RemoteProtocolError, match="2 to 4097 knots"):
        ChildNumbers.read(ColumnReader(ChildNumbers(100, np.array([100])).to_bytes()))
