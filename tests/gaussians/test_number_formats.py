"""Number formats against their twins bit for bit, their limits, and their distance from float32."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from gaussians import fixed_records
from gaussians.errors import InputError
from gaussians.fixed_point import alpha_of, widths
from gaussians.fixed_records import FixedFormat
from gaussians.float32_math import exp_float32
from gaussians.half_precision import HalfFormat, to_half
from gaussians.number_formats import FORMATS, FormatImage, rasterise_in_format
from gaussians.projection import project
from gaussians.quality import psnr_db
from gaussians.rasterization import rasterise
from gaussians.tiling import TileGrid, TileLists, row_spans, tile_lists
from tests.naive import number_formats as naive
from tests.naive.tiling import nested
from tests.strategies import build_case, cases, small_rig

HW = FixedFormat("hw")
HALVES = [f for f in FORMATS.values() if isinstance(f, HalfFormat) and f.name != "fp32"]
U, V, A, B, C, THRESHOLD, OPACITY, RED, GREEN, BLUE = range(10)
GRID = TileGrid(11, 6, 4)


@njit
def _exp(p):
    return exp_float32(p)


@njit
def _halves(values, out):
    for i in range(values.size):
        out[i] = to_half(values[i])


def splat(
    u: float = 5.5,
    v: float = 2.5,
    conic: tuple[float, float, float] = (0.1, 0.0, 0.1),
    opacity: float = 0.5,
    colour: tuple[float, float, float] = (0.25, 0.5, 1.0),
) -> list[float]:
    return [u, v, *conic, -np.log(255 * opacity), opacity, *colour]


def everywhere(features: list[list[float]], grid: TileGrid = GRID) -> tuple[np.ndarray, TileLists]:
    """The features, and lists in which every splat stands in every tile."""
    tiles = grid.tiles_x * grid.tiles_y
    ranks = np.tile(np.arange(len(features), dtype=np.int32), tiles)
    offsets = np.arange(tiles + 1, dtype=np.int64) * len(features)
    return np.array(features, np.float32), TileLists(grid.tiles_x, grid.tiles_y, offsets, ranks)


def draw(features, lists, number_format=HW, grid=GRID, background=(0.0, 0.0, 0.0)) -> FormatImage:
    return rasterise_in_format(number_format, features, lists, grid, background)


def random_splats(seed: int, count: int = 12) -> tuple[np.ndarray, TileLists]:
    """Round and long, faint and opaque, small and large splats around an 11 x 6 image."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        angle, sizes = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(0.6), np.log(60), 2))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        inverse = turn @ np.diag(sizes**-2.0) @ turn.T
        far = rng.uniform(4000, 30_000) if rng.random() < 0.2 else 0
        centre = rng.uniform(-4, 14) + far, rng.uniform(-4, 10) - far
        inverse = inverse / max(1, far) ** 2
        conic = inverse[0, 0], inverse[0, 1], inverse[1, 1]
        opacity = rng.choice([0.0040, 0.05, 0.5, 1.0, 7.9, 44.0])
        made.append(splat(*centre, conic, opacity, tuple(rng.uniform(0, 1.5, 3))))
    return everywhere(made)


# ---------------------------------------------------------------- bit equality


@pytest.mark.nojit
@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    background=st.sampled_from([(0.0, 0.0, 0.0), (1.0, 0.3, 7.9)]),
    narrow=st.booleans(),
)
def test_hw_is_its_integer_twin(seed, background, narrow):
    wide = replace(HW, conic_mantissa=12, power_fraction=9, exp_index=4, accumulator_fraction=11)
    number_format = wide if narrow else HW
    features, lists = random_splats(seed)
    made = draw(features, lists, number_format, background=background)
    image, held = naive.fixed_image(features, nested(lists), (6, 11), 4, background, number_format)
    assert np.array_equal(made.image, image) and made.image.dtype == np.float32
    assert made.saturations.accumulators == held


@settings(max_examples=40)
@given(case=cases())
def test_hw_is_its_twin_on_nasty_scenes(case):
    display = case.rig.display
    grid = TileGrid(display.width, display.height, 4)
    splats = project(case.scene, case.rig)
    lists = tile_lists(row_spans(splats, grid), 1)
    features = splats.features[1]
    features[:, RED : BLUE + 1] = np.random.default_rng(0).uniform(0, 1, (len(features), 3))
    made = draw(features, lists, grid=grid)
    if made.saturations.total:
        return  # the twin takes what fits; limits have tests of their own
    shape = display.height, display.width
    image, _ = naive.fixed_image(features, nested(lists), shape, 4, (0.0, 0.0, 0.0), HW)
    assert np.array_equal(made.image, image)


@pytest.mark.parametrize("number_format", HALVES, ids=lambda f: f.name)
def test_half_precision_is_its_twin(number_format):
    for seed in range(6):
        features, lists = random_splats(seed)
        made = draw(features, lists, number_format)
        image = naive.half_image(features, nested(lists), (6, 11), 4, number_format, _exp)
        assert np.array_equal(made.image, image)


@pytest.mark.nojit
def test_rounding_to_half_is_that_of_ieee():
    rng = np.random.default_rng(3)
    values = rng.integers(0, 2**32, 40_000, dtype=np.uint64).astype(np.uint32).view(np.float32)
    ties = (np.arange(2000) + 0.5).astype(np.float32) * np.float32(2.0**-24)
    steps = np.array([65503, 65504, 65519.99, 65520, 65536, 1e38, 2048.5, 2049, 2051], np.float32)
    near = rng.normal(0, 1, 20_000).astype(np.float32)
    special = np.array([0.0, np.inf, 2.0**-14, np.nextafter(np.float32(2.0**-14), 0)], np.float32)
    values = np.concatenate([values[~np.isnan(values)], ties, -ties, steps, -steps, near, special])
    out = np.empty_like(values)
    with np.errstate(over="ignore"):
        _halves(values, out)
        expected = values.astype(np.float16).astype(np.float32)
    assert np.array_equal(out, expected)


def test_fp32_is_the_reference_renderer():
    features, lists = random_splats(1)
    made = draw(features, lists, FORMATS["fp32"], background=(0.1, 0.2, 0.3))
    expected = rasterise(features, lists, GRID, (0.1, 0.2, 0.3)).image
    assert np.array_equal(made.image, expected) and made.saturations.total == 0


# ---------------------------------------------------------------- the contract


def test_constants_are_the_documented_ones():
    """Numbers that docs/number_formats.md writes out for whoever builds the hardware."""
    w = widths(HW)
    assert (w.log2_255, w.alpha_max, w.one, w.stop, w.power_max) == (32745, 4055, 65535, 7, 131071)
    assert (w.weight_shift, w.accumulator_max) == (15, 65535)
    assert w.table[[0, 1, 63]].tolist() == [65536, 64830, 33125] and len(w.slopes) == 64
    assert (w.table[63] - w.slopes[63], w.slopes.max(), w.slopes.min()) == (32768, 706, 357)


def test_alpha_is_within_one_step_of_the_exponential():
    w = widths(HW)
    alpha = njit(lambda power, reach, w: alpha_of(power, reach, w))
    for reach in (0, 4096, 32745, 40000):
        for power in range(0, reach + 1, 37):
            exact = min(2.0 ** ((reach - power) / 4096) / 255, 0.99) * 4096
            assert abs(alpha(power, reach, w) - exact) < 0.75


def test_weights_and_the_rest_sum_to_what_came_in():
    """White on white: what a splat takes from the background it gives back."""
    white = (1.0, 1.0, 1.0)
    features, lists = everywhere([splat(opacity=o, colour=white) for o in (0.3, 0.7, 0.2)])
    image = draw(features, lists, background=white).image
    assert np.abs(image - 1).max() <= 3 * 2.0**-14
    empty = everywhere([])
    assert (draw(features[:0], empty[1], background=(0.5, 1.0, 2.0)).image == (0.5, 1.0, 2.0)).all()


def test_merged_parents_keep_their_opacity():
    """Opacities above 1 widen the flat top; nothing is clamped up to 44 and far beyond."""
    for opacity in (1.0, 8.0, 44.0, 60_000.0):
        features, lists = everywhere([splat(opacity=opacity, conic=(0.2, 0.05, 0.1))])
        made = draw(features, lists)
        assert made.saturations.total == 0
        assert psnr_db(made.image, rasterise(features, lists, GRID, (0.0, 0.0, 0.0)).image) > 75


def test_what_does_not_fit_is_counted_once_per_splat():
    features, lists = everywhere(
        [
            splat(u=-4096.0 * 128, conic=(1e-9, 0, 1e-9)),
            splat(u=4096.0 * 128, v=-5000.0, conic=(1e-9, 0, 1e-9)),
            splat(v=np.inf, conic=(1e-9, 0, 1e-9)),
            splat(conic=(200_000.0, 0.0, 200_000.0)),
            splat(colour=(8.0, 0.0, 9.0)),
            splat(colour=(7.999, 0.0, 0.0)),
        ]
    )
    features[5, THRESHOLD] = -22.2  # opacity 17 million
    found = draw(features, lists).saturations
    assert (found.centres, found.conics, found.opacities, found.colours) == (2, 1, 1, 1)
    unlisted = TileLists(
        lists.tiles_x, lists.tiles_y, np.zeros_like(lists.offsets), lists.splats[:0]
    )
    assert draw(features, unlisted).saturations.total == 0


def test_accumulators_are_held_at_four_and_counted():
    features, lists = everywhere([splat(opacity=1.0, conic=(0.0, 0.0, 0.0), colour=(5.0, 1.0, 0))])
    made = draw(features, lists)
    assert made.saturations.accumulators == GRID.width * GRID.height
    assert (made.image[..., 0] == 4 - 2.0**-14).all() and made.image[..., 1].max() < 1


def test_far_centres_take_a_coarser_scale():
    """A huge splat beside the window keeps its place: only what it cannot show is dropped."""
    centres = np.array([[4095.9, -4096], [4096, 0], [3, -9000.25], [1e5, 1.0]], np.float32)
    integers, scales, over = fixed_records._shared_scale(centres, 8)
    assert scales.tolist() == [0, 1, 2, 5] and not over.any()
    assert integers.tolist() == [[1048550, -1048576], [524288, 0], [192, -576016], [800000, 8]]
    features, lists = everywhere([splat(u=20_000.0, conic=(1e-8, 0.0, 1e-6), opacity=0.9)])
    made = draw(features, lists)
    assert made.saturations.total == 0
    assert psnr_db(made.image, rasterise(features, lists, GRID, (0.0, 0.0, 0.0)).image) > 75


def test_a_conic_that_rounds_up_to_a_power_of_two_takes_the_next_exponent():
    value = np.float32(2.0 - 2.0**-20)
    conics = np.array(
        [[value, 0, 0.5], [1.0, -value, 1.0], [0, 0, 0], [1e-30, 0, 1e-30]], np.float32
    )
    mantissas, exponents, over = fixed_records._shared_exponent(conics, 16, np.zeros(4, np.int32))
    assert mantissas.tolist() == [[16384, 0, 4096], [8192, -16384, 8192], [0, 0, 0], [0, 0, 0]]
    assert exponents.tolist() == [13, 13, 15, 46] and not over.any()


def test_half_precision_reports_what_becomes_infinite():
    features, lists = everywhere([splat(opacity=70_000.0), splat(colour=(1e5, 0.0, 0.0))])
    found = draw(features, lists, FORMATS["fp16_features"]).saturations
    assert (found.centres, found.conics, found.opacities, found.colours) == (0, 0, 1, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"conic_mantissa": 21}, "must be at most 36"),
        ({"centre_fraction": 0}, "centre_fraction must be at least 1"),
        ({"exp_index": 13}, "exp_index must lie in 1..power_fraction"),
        ({"alpha_fraction": 16}, "alpha_fraction must lie in 7..15"),
    ],
)
def test_widths_that_cannot_work_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(HW, **change)


def test_windows_and_backgrounds_beyond_the_format_are_refused():
    features, lists = everywhere([splat()])
    with pytest.raises(InputError, match=r"window must lie within -4096\.\.4096 px"):
        draw(features, lists, grid=TileGrid(4100, 6, 4))
    with pytest.raises(InputError, match=r"background must lie in 0\.\.8"):
        draw(features, lists, background=(0.0, -0.1, 0.0))
    features[0, A] = np.nan
    with pytest.raises(InputError, match="not NaN"):
        draw(features, lists)
    features[0, A], features[0, THRESHOLD] = 1, 0.1
    with pytest.raises(InputError, match="thresholds of listed splats must be <= 0"):
        draw(features, lists)


def test_formats_rank_as_their_widths_say():
    """On an ordinary scene: every format within reach of float32, hw beyond 70 dB, less is less."""
    rig = small_rig(120, 90)
    case = build_case([("ordinary", s) for s in range(8)], rig)
    grid = TileGrid(120, 90, 4)
    splats = project(case.scene, rig, eyes=1)
    splats.features[0, :, RED : BLUE + 1] = np.random.default_rng(1).uniform(
        0, 1, (len(splats.ids), 3)
    )
    lists = tile_lists(row_spans(splats, grid), 0)
    reference = rasterise(splats.features[0], lists, grid, (0.0, 0.0, 0.0)).image

    def psnr(number_format) -> float:
        found = psnr_db(draw(splats.features[0], lists, number_format, grid).image, reference)
        assert found is not None
        return found

    assert psnr(HW) > 70
    assert psnr(FORMATS["fp16"]) < psnr(FORMATS["fp16_features"])
    assert psnr(FORMATS["fp16"]) < psnr(HW)
    for name, bits in (("alpha_fraction", 8), ("colour_fraction", 7), ("accumulator_fraction", 10)):
        assert psnr(replace(HW, **{name: bits})) < psnr(HW) - 3
