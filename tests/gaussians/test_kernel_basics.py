"""The small building blocks of the kernels: threads, depth order, exp and ln."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import njit

from gaussians import parallel
from gaussians.errors import InputError
from gaussians.float32_math import exp_float32, ln_float64
from gaussians.sorting import depth_order


@njit
def _exp_all(values, out):
    for i in range(values.size):
        out[i] = exp_float32(values[i])


@njit
def _ln_all(values, out):
    for i in range(values.size):
        out[i] = ln_float64(values[i])


@pytest.mark.nojit
def test_exp_is_within_two_ulp():
    values = -np.random.default_rng(1).uniform(0, 20, 20_000).astype(np.float32)
    values[0] = 0
    out = np.empty_like(values)
    _exp_all(values, out)
    exact = np.exp(values.astype(np.float64))
    assert np.abs(out / exact - 1).max() < 2 * 2.0**-23
    assert out[0] == 1


@pytest.mark.nojit
def test_ln_is_within_two_ulp_and_exact_at_one():
    values = np.random.default_rng(2).uniform(1e-3, 1e4, 20_000)
    values[0] = 1
    out = np.empty_like(values)
    _ln_all(values, out)
    exact = np.log(values)
    assert np.abs(out - exact).max() <= np.max(2 * np.spacing(np.abs(exact)))
    assert out[0] == 0


@given(hnp.arrays(np.float32, st.integers(0, 300), elements=st.sampled_from([0.2, 1, 2, 2e4])))
def test_depth_order_breaks_ties_by_id(depths):
    ids = np.arange(5, 5 + len(depths), dtype=np.int32)
    assert np.array_equal(depth_order(depths, ids), ids[np.lexsort((ids, depths))])


@given(hnp.arrays(np.float32, 50, elements=st.floats(0.0, 2.0**126, width=32)))
def test_depth_order_follows_every_bit(depths):
    ids = np.arange(len(depths), dtype=np.int32)
    assert np.array_equal(depth_order(depths, ids), np.lexsort((ids, depths)))


def test_chunks_cover_the_range_once_in_order_on_any_number_of_threads():
    before = parallel.threads()
    try:
        for workers in (1, 3):
            parallel.set_threads(workers)
            pieces = parallel.run_chunks(lambda begin, end: list(range(begin, end)), 101)
            assert [i for piece in pieces for i in piece] == list(range(101))
            assert parallel.run_chunks(lambda begin, end: 1 / 0, 0) == []
    finally:
        parallel.set_threads(before)


@pytest.mark.parametrize("count", [0, -1, 2.0, 5000])
def test_set_threads_refuses(count):
    with pytest.raises(InputError, match=r"threads must be an integer from 1 to 1024"):
        parallel.set_threads(count)
