"""Every number format: stated errors hold, nothing is clipped, no thread decides a bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from gaussians import compression as c
from gaussians import parallel
from gaussians.codebook import Codebook
from gaussians.errors import InputError
from gaussians.scene import normalised_quaternions

seeds = st.integers(0, 10_000)


def float32(values: object) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def spread(seed: int, low: float, high: float, count: int = 500) -> NDArray[np.float32]:
    """Float32 values over a range, its ends and the zero in it included."""
    values = np.random.default_rng(seed).uniform(low, high, count).astype(np.float32)
    ends = np.array([low, high, 0.0 if low <= 0 <= high else low], np.float32)
    return np.clip(np.concatenate([values, ends]), np.float32(low), np.float32(high))


def test_exp2_is_right_and_exact_at_whole_numbers() -> None:
    x = np.concatenate([np.linspace(-149.9, 127.9, 50_001), np.arange(-149.0, 128)])
    assert np.abs(c.exp2(x) / np.exp2(x) - 1).max() < 1e-15
    assert np.array_equal(c.exp2(np.arange(-149.0, 128)), np.exp2(np.arange(-149.0, 128)))


@given(seeds, st.sampled_from([(-1.0, 3.0), (0.25, 0.26), (-9e4, 10.0)]))
@settings(max_examples=20, deadline=None)
def test_linear_field(seed: int, ends: tuple[float, float]) -> None:
    field = c.LinearField(float(np.float32(ends[0])), float(np.float32(ends[1])))
    values = spread(seed, field.low, field.high)
    codes, valid = field.encode(values)
    assert valid.all()
    assert np.abs(field.decode(codes).astype(float) - values).max() <= field.max_error
    assert field.max_error < 0.51 * field.step + 2.0**-23 * max(map(abs, ends))


@given(seeds, st.sampled_from([1.0, 0.3, 44.0]))
@settings(max_examples=20, deadline=None)
def test_square_root_field(seed: int, high: float) -> None:
    field = c.SquareRootField(float(np.float32(high)))
    values = spread(seed, 0.0, field.high) ** 2 / np.float32(high)
    values = np.minimum(values, np.float32(field.high))
    codes, valid = field.encode(values)
    decoded = field.decode(codes)
    assert valid.all()
    limits = [field.max_error(float(v)) for v in values]
    assert (np.abs(decoded.astype(float) - values) <= limits).all()
    assert (decoded[values == 0] == 0).all()
    assert field.max_error(1.0) < 1.01 * math.sqrt(high) / 65535 + 1e-6


@pytest.mark.parametrize("round_up", [False, True])
@given(seed=seeds, decades=st.sampled_from([0.0, 3.0, 12.0, 40.0]))
@settings(max_examples=20, deadline=None)
def test_log_field(round_up: bool, seed: int, decades: float) -> None:
    values = (10.0 ** spread(seed, -decades, min(decades, 9))).astype(np.float32)
    values[::7] = 0.0
    field = c.LogField.covering(values, round_up=round_up)
    codes, valid = field.encode(values)
    decoded = field.decode(codes).astype(float)
    assert valid.all()
    assert np.array_equal(decoded == 0, values == 0)
    ratios = decoded[values > 0] / values[values > 0]
    assert ratios.max() <= field.max_ratio
    assert ratios.min() >= (1.0 if round_up else 1 / field.max_ratio)
    assert field.max_ratio < 1 + math.log(2) * field.step * (1.01 if round_up else 0.51) + 1e-6


@pytest.mark.parametrize("round_up", [False, True])
def test_log_codes_are_the_best_ones(round_up: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """No other code is nearer (or, rounding up, smaller and enough), even if log2 is inexact."""
    values = (10.0 ** spread(1, -3, 1, 3000)).astype(np.float32)
    field = c.LogField.covering(values, round_up=round_up)
    exact_log2 = np.log2
    for error in (0.0, 0.4, -0.4):
        monkeypatch.setattr(np, "log2", lambda x, e=error: exact_log2(x) + e * field.step)
        codes = field.encode(values)[0].astype(int)
        table = field.decode(np.arange(65536).astype(np.uint16)).astype(float)
        if round_up:
            assert (table[codes - 1] < values).all()
            assert (table[codes] >= values).all()
        else:
            off = np.abs(np.log(table[codes] / values))
            for other in (codes - 1, codes + 1):
                assert (
                    off <= np.abs(np.log(table[np.clip(other, 1, 65535)] / values)) + 3e-7
                ).all()


@given(seeds, st.sampled_from([16.0, 1.0, 2.0**-10]), st.sampled_from([0.01, 30.0, 8000.0]))
@settings(max_examples=30, deadline=None)
def test_position_field(seed: int, tile_m: float, size_m: float) -> None:
    size_m = min(size_m, 30_000 * tile_m)
    field = c.PositionField(tile_m)
    means = np.random.default_rng(seed).uniform(-size_m, size_m, (300, 3)).astype(np.float32)
    means[:4] = float32(
        [
            [0, -0.0, tile_m],
            [-tile_m] * 3,
            [np.nextafter(np.float32(0), np.float32(-1))] * 3,
            [0] * 3,
        ]
    )
    tile, offset, valid = field.encode(means)
    assert valid.all()
    errors = np.abs(field.decode(tile, offset).astype(float) - means)
    assert (errors <= field.max_error(float(np.abs(means).max()))).all()
    assert field.max_error(0.0) < 0.51 * tile_m / 65536


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = normalised_quaternions(rng.normal(size=(300, 4)))
    q[:6] = float32(
        [
            [1, 0, 0, 0],
            [0, 0, 0, -1],
            [0.5] * 4,
            [-0.5] * 4,
            [0.70710678, 0.70710678, 0, 0],
            [0, -1, 0, 0],
        ]
    )
    decoded = c.decode_rotation(*c.encode_rotation(q)).astype(float)
    assert np.abs(np.linalg.norm(decoded, axis=1) - 1).max() < 2e-7
    wide = q / np.linalg.norm(q.astype(float), axis=1, keepdims=True)
    sign = np.sign((decoded * wide).sum(axis=1, keepdims=True))
    angle = 4 * np.arcsin(np.linalg.norm(decoded - sign * wide, axis=1) / 2)
    assert angle.max() <= c.ROTATION_ERROR_RAD
    assert np.array_equal(decoded[0], [1, 0, 0, 0])


def test_values_outside_are_reported_not_clipped() -> None:
    linear, root = c.LinearField(-1, 3), c.SquareRootField(2.0)
    log, up = c.LogField(-3, 3), c.LogField(-3, 3, round_up=True)
    assert linear.encode(float32([-1.001, -1, 3, 3.001]))[1].tolist() == [
        False,
        True,
        True,
        False,
    ]
    assert root.encode(float32([-0.1, 0, 2, 2.001]))[1].tolist() == [False, True, True, False]
    for field in (log, up):
        assert field.encode(float32([0.1, 0, 8, 8.1]))[1].tolist() == [False, True, True, False]
    far = float32([[0, 0, 32767.5 * 16], [0, 1e9, 0], [0, 0, 32768 * 16]])
    assert c.PositionField(16.0).encode(far)[2].tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: c.LinearField(1, 1), "range must rise"),
        (lambda: c.SquareRootField(0.0), "must end above 0"),
        (lambda: c.LogField(3, -3), "must rise within"),
        (lambda: c.PositionField(10.0), "power of two"),
    ],
)
def test_bad_ranges(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=message):
        make()


def materials(seed: int, count: int, dimensions: int = 9) -> NDArray[np.float32]:
    """A few materials under changing light, and noise."""
    rng = np.random.default_rng(seed)
    base = rng.normal(0, 0.2, (40, dimensions))
    vectors = base[rng.integers(0, 40, count)] * rng.normal(1, 0.2, (count, 1))
    return (vectors + rng.normal(0, 0.02, (count, dimensions))).astype(np.float32)


def brute_force(book: NDArray[np.float16], vectors: NDArray[np.float64]) -> NDArray[np.int64]:
    distances = ((vectors[:, None] - book[None].astype(float)) ** 2).sum(axis=2)
    return distances.argmin(axis=1)


def test_codebook_finds_the_nearest_words() -> None:
    vectors = materials(1, 3000)
    book = Codebook.train(vectors, words=64, stages=2, seed=5)
    codes, valid = book.encode(vectors)
    rest = np.rint(vectors.astype(float) * 2**14) / 2**14
    for stage, words in enumerate(book.stages):
        nearest = brute_force(words, rest)
        assert np.array_equal(codes[:, stage], nearest)
        rest -= words[nearest]
    assert valid.all()
    errors = np.sqrt(((book.decode(codes) - vectors) ** 2).mean())
    one_stage = Codebook(book.stages[:1])
    first = np.sqrt(((one_stage.decode(codes[:, :1]) - vectors) ** 2).mean())
    assert errors < 0.85 * first < 0.5 * vectors.std()


def test_ties_between_words_go_to_the_lower_one() -> None:
    """Words equally far from a vector: float32 cannot reliably tell, exact sums can."""
    rng = np.random.default_rng(0)
    words = np.unique((rng.integers(-8000, 8000, (50, 45)) / 2**13).astype(np.float16), axis=0)
    i, j = rng.integers(0, len(words), (2, 200))
    middles = ((words[i].astype(float) + words[j]) / 2).astype(np.float32)
    codes = Codebook((words,)).encode(middles)[0][:, 0]
    on_grid = np.rint(middles.astype(float) * 2**14) / 2**14
    assert np.array_equal(codes, brute_force(words, on_grid))


def test_training_is_reproducible_on_any_number_of_threads() -> None:
    vectors = materials(2, 6000)
    before = parallel.threads()
    books, codes = [], []
    try:
        for count in (1, 2):
            parallel.set_threads(count)
            with threadpool_limits(count):
                books.append(Codebook.train(vectors, words=256, stages=2, seed=7))
            codes.append(books[-1].encode(vectors)[0])
    finally:
        parallel.set_threads(before)
    for one, two in zip(books[0].stages, books[1].stages, strict=True):
        assert np.array_equal(one, two)
        assert np.array_equal(one.astype(float) * 2**14, np.rint(one.astype(float) * 2**14))
    assert np.array_equal(codes[0], codes[1])
    other = Codebook.train(vectors, words=256, stages=1, seed=8)
    assert not np.array_equal(other.stages[0], books[0].stages[0])


def test_codebook_sizes_and_outliers() -> None:
    vectors = materials(3, 100)
    book = Codebook.train(vectors, words=4096, stages=1, seed=1)
    assert len(book.stages[0]) <= 100 // 8
    assert book.size_bytes == 2 * 9 * len(book.stages[0])
    assert len(Codebook.train(vectors[:1], words=9, stages=1, seed=1).stages[0]) == 1
    vectors[4, 2] = 9.0  # beyond AC_RANGE
    vectors[5, 1] = 7.0  # far from every word
    valid = book.encode(vectors)[1]
    assert np.flatnonzero(~valid).tolist() == [4, 5]
    with pytest.raises(InputError, match="needs a vector"):
        Codebook.train(vectors[4:5], words=4, stages=1, seed=1)
    with pytest.raises(InputError, match=r"1\.\.65536 words"):
        Codebook.train(vectors, words=0, stages=1, seed=1)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_fewer_codes_have_the_errors_of_their_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = (10.0 ** rng.uniform(-3, 1, 300)).astype(np.float32)
    for round_up in (False, True):
        field = c.LogField.covering(sizes, round_up=round_up, top=255)
        codes, valid = field.encode(sizes)
        ratios = field.decode(codes).astype(float) / sizes
        assert valid.all() and 1 <= codes.min() <= codes.max() <= 255
        assert (1.0 if round_up else 1 / field.max_ratio) <= ratios.min()
        assert ratios.max() <= field.max_ratio
    line = c.LinearField(-1.0, 2.0, 127)
    values = rng.uniform(-1, 2, 300).astype(np.float32)
    codes, _ = line.encode(values)
    assert codes.max() <= 127
    assert np.abs(line.decode(codes).astype(float) - values).max() <= line.max_error
    quaternions = normalised_quaternions(rng.normal(size=(300, 4)))
    largest, three = c.encode_rotation(quaternions, 255)
    turned = c.decode_rotation(largest, three, 255).astype(float)
    cosine = np.minimum(np.abs((turned * quaternions).sum(axis=1)), 1)
    assert three.max() <= 254
    assert 2 * np.arccos(cosine).max() <= c.ROTATION_ERROR_RAD * 65535 / 255 + 1e-3
