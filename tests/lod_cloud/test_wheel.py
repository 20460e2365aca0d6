"""The timing wheel's bounds: directions lie in their sectors, hands may run backwards."""

from __future__ import annotations

import numpy as np
import pytest

from lod_cloud.criterion import SearchRequest
from lod_cloud.search import make_search, wheel_buckets
from lod_cloud.search.sectors import SECTORS, SIDE, _unbent, sector_of, sector_table
from tests.lod_cloud.search_trees import TREES


def nasty_directions(rng: np.random.Generator) -> np.ndarray:
    """Random ones, of any length, and those on edges between cells and between cube faces."""
    edges = _unbent(np.linspace(-1, 1, 2 * SIDE + 1))
    faces = [
        np.roll((side, a, b), shift)
        for side in (-1.0, 1.0)
        for shift in range(3)
        for a in edges
        for b in edges
    ]
    others = rng.normal(size=(2000, 3)) * 10.0 ** rng.uniform(-8, 10, (2000, 1))
    tilted = np.array(faces) + rng.integers(-2, 3, (len(faces), 3)) * 2.0**-24
    return np.concatenate([faces, tilted, others]).astype(np.float32)


@pytest.mark.nojit
def test_directions_lie_in_the_cap_of_their_sector() -> None:
    axes, cosines, _ = sector_table()
    seen = set()
    for x, y, z in nasty_directions(np.random.default_rng(4)):
        sector = int(sector_of(x, y, z))
        direction = np.array([x, y, z], np.float64)
        assert axes[sector] @ direction >= cosines[sector] * np.linalg.norm(direction)
        seen.add(sector)
    assert seen == set(range(SECTORS))


@pytest.mark.nojit
def test_any_sector_will_do_for_no_direction_at_all() -> None:
    zero = np.float32(0.0)
    assert 0 <= sector_of(zero, zero, zero) < SECTORS


@pytest.mark.parametrize("step", [0.002, 0.01, 0.05])
def test_hands_that_run_backwards(step: float) -> None:
    """There and back along each axis: a hand that the camera leaves behind stands below zero."""
    tree = TREES["large binary"]()
    searches = [make_search(method, tree) for method in ("flat", "wheel")]
    changes = 0
    for axis in range(3):
        for i in range(240):
            x, y, z = np.eye(3)[axis] * step * (i if i < 80 else 160 - i)
            request = SearchRequest((x, y, z), 200.0, 6.0)
            flat, wheel = (search.search(request) for search in searches)
            assert np.array_equal(flat.expanded, wheel.expanded)
            assert np.array_equal(flat.collapsed, wheel.collapsed)
            changes += len(flat.expanded) + len(flat.collapsed)
    assert changes > 10


def test_hands_enter_coarse_buckets_one_by_one() -> None:
    """A search that popped the coarse buckets of many hands would take several times as long."""
    hands, rates = wheel_buckets.START_M.copy(), np.empty(wheel_buckets.HANDS)
    spans = np.empty((wheel_buckets.HANDS, 4), np.int32)
    step = np.array([0.062, 0.0, 0.0])  # walking, a search every four frames
    entered = []
    for _ in range(200):
        wheel_buckets._advance(step, hands, rates, *sector_table(), spans)
        entered.append(int(spans[:, 3].sum()))
    assert 50 < max(entered) < 1.3 * np.mean(entered)
