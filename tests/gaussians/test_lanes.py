"""Lanes: compiled or not, every operation gives the bits of the same float32 operation in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from numba import config, njit
from numba.core.errors import TypingError

from gaussians.float32_math import exp_float32
from gaussians.lanes import (
    WIDTH,
    bits,
    broadcast,
    count,
    halves,
    highest_bit,
    load,
    lowest_bit,
    minimum,
    pair,
    prefetch,
    scaled,
    select,
    store,
)

pytestmark = pytest.mark.nojit

SPECIAL = np.float32([0.0, -0.0, np.inf, -np.inf, np.nan, 1e-45, -1e-45, 3e38, 1.0, -1.0])
TWO = np.float32(2)
EXPONENT_ZERO = np.float32(1.5 * 2**23)


def numbers(seed: int) -> np.ndarray:
    """[16] float32 of all sizes, special ones among them."""
    rng = np.random.default_rng(seed)
    values = (rng.normal(size=WIDTH) * 10.0 ** rng.integers(-38, 38, WIDTH)).astype(np.float32)
    values[rng.choice(WIDTH, 6, replace=False)] = rng.choice(SPECIAL, 6)
    return values


@njit(error_model="numpy")
def _arithmetic(x, y, number, out):  # [16], [16], float32, [12, 16]
    a, b = load(x, 0), load(y, 0)
    store(out, 0, a + b)
    store(out, 16, a - b)
    store(out, 32, a * b)
    store(out, 48, a + number)
    store(out, 64, a - number)
    store(out, 80, a * number)
    store(out, 96, number + a)
    store(out, 112, number - a)
    store(out, 128, number * a)
    store(out, 144, broadcast(number))
    first, second = halves(pair(a, b) * pair(number, TWO))
    store(out, 160, first)
    store(out, 176, second)


@pytest.mark.parametrize("seed", range(20))
def test_arithmetic_rounds_every_lane_on_its_own(seed: int) -> None:
    x, y, number = numbers(seed), numbers(100 + seed), numbers(200 + seed)[0]
    out = np.empty((12, WIDTH), np.float32)
    with np.errstate(all="ignore"):
        _arithmetic(x, y, number, out)
        plain = [x + y, x - y, x * y, x + number, x - number, x * number]
        turned = [number + x, number - x, number * x]
        wanted = [*plain, *turned, np.full(WIDTH, number), x * number, y * TWO]
    np.testing.assert_array_equal(out, np.stack(wanted))
    signs = np.signbit(out) == np.signbit(np.stack(wanted))
    assert (signs | np.isnan(out)).all()


@njit(error_model="numpy")
def _choices(x, y, number, out, counts):  # [16], [16], float32, [10, 16], [10]
    a, b = load(x, 0), load(y, 0)
    store(out, 0, select(a < b, a, b))
    store(out, 16, select(a <= b, a, number))
    store(out, 32, select(a >= number, a, b))
    store(out, 48, select((a < b) & (a < number), a, b))
    store(out, 64, select((a < b) | (a < number), a, b))
    store(out, 80, select(~(a < b), a, b))
    store(out, 96, select(a < number, a, b))
    both = pair(a, b) <= pair(b, a)
    first, second = halves(both)
    store(out, 112, select(first, a, b))
    store(out, 128, select(second, a, b))
    store(out, 144, minimum(select(a <= a, a, number), number))
    counts[0], counts[1], counts[2] = count(a < b), count(both), count(~(a < b) & first)


@pytest.mark.parametrize("seed", range(20))
def test_comparisons_are_false_for_nan_and_masks_choose(seed: int) -> None:
    x, y, number = numbers(seed), numbers(100 + seed), np.float32(seed - 10)
    x[3] = y[5]
    x[7] = y[7]
    out, counts = np.empty((10, WIDTH), np.float32), np.empty(3, np.int64)
    _choices(x, y, number, out, counts)
    less = x < y
    wanted = [
        np.where(less, x, y),
        np.where(x <= y, x, number),
        np.where(x >= number, x, y),
        np.where(less & (x < number), x, y),
        np.where(less | (x < number), x, y),
        np.where(~less, x, y),
        np.where(x < number, x, y),
        np.where(x <= y, x, y),
        np.where(y <= x, x, y),
        np.minimum(np.where(np.isnan(x), number, x), number),
    ]
    np.testing.assert_array_equal(out, np.stack(wanted))
    either = [less.sum(), (x <= y).sum() + (y <= x).sum(), (~less & (x <= y)).sum()]
    assert counts.tolist() == either


@njit(error_model="numpy")
def _exponentials(values, out):  # [n], [3, n]
    for start in range(0, values.size, WIDTH):
        lanes = load(values, start)
        prefetch(values, start)
        store(out, start, exp_float32(lanes))
        first, _second = halves(exp_float32(pair(lanes, lanes)))
        store(out, values.size + start, first)
        for i in range(start, start + WIDTH):
            out[2, i] = exp_float32(values[i])


def test_exp_has_one_definition_for_numbers_lanes_and_pairs() -> None:
    values = -np.random.default_rng(5).uniform(0, 80, 4096).astype(np.float32)
    values[:2] = 0, -80
    out = np.empty((3, values.size), np.float32)
    _exponentials(values, out)
    np.testing.assert_array_equal(out[0].view(np.uint32), out[2].view(np.uint32))
    np.testing.assert_array_equal(out[1].view(np.uint32), out[2].view(np.uint32))


@njit(error_model="numpy")
def _scale_all(values, exponents, out):
    store(out, 0, scaled(load(values, 0), load(exponents, 0)))
    for i in range(WIDTH):
        out[1, i] = scaled(values[i], exponents[i])


def test_scaled_multiplies_by_a_power_of_two() -> None:
    powers = np.arange(-120, 120, 15)
    values = np.linspace(0.5, 1.5, WIDTH, dtype=np.float32)
    out = np.empty((2, WIDTH), np.float32)
    _scale_all(values, EXPONENT_ZERO + powers.astype(np.float32), out)
    np.testing.assert_array_equal(out[0], np.ldexp(values, powers))
    np.testing.assert_array_equal(out[1], out[0])


@njit(error_model="numpy")
def _move(source, start, target):
    store(target, start, load(source, start + 1))


@njit(error_model="numpy")
def _bits_below(x, limit):  # [16], float32
    number = bits(load(x, 0) < limit)
    if number == 0:
        return number, -1, -1
    return number, lowest_bit(number), highest_bit(number)


def test_bits_of_a_mask_begin_with_the_first_lane() -> None:
    rng = np.random.default_rng(0)
    for number in [0, 1, 1 << 15, 0x8001, 0xFFFF, *rng.integers(0, 1 << 16, 40)]:
        places = [i for i in range(WIDTH) if number >> i & 1]
        x = np.full(WIDTH, np.nan, np.float32)
        x[places] = 0.0
        expected = (number, places[0], places[-1]) if places else (0, -1, -1)
        assert _bits_below(x, TWO) == expected


def test_load_and_store_count_flat_and_need_no_alignment() -> None:
    source, target = np.arange(60, dtype=np.float32).reshape(6, 10), np.zeros((5, 8), np.float32)
    _move(source, 7, target)
    assert target.reshape(-1).tolist() == [0.0] * 7 + list(range(8, 24)) + [0.0] * 17


@pytest.mark.skipif(config.DISABLE_JIT, reason="needs numba's compiler")
def test_load_refuses_what_is_not_contiguous() -> None:
    with pytest.raises(TypingError, match="load"):
        _move(np.zeros((6, 10), np.float32)[:, ::2], 0, np.zeros(64, np.float32))
    with pytest.raises(TypingError, match="load"):
        _move(np.zeros(64), 0, np.zeros(64, np.float32))
