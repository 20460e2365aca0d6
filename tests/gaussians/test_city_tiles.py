"""Tiled cities: exact counts, the same bits every time, neighbours in neighbouring tiles."""

from __future__ import annotations

import numpy as np
import pytest

from gaussians import parallel
from gaussians.errors import InputError
from gaussians.scene import FIELDS, concatenate
from gaussians.synthetic import DENSITIES, TiledCity, city_tiles


@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.parametrize("leaves", [1000, 4321, 150_000])
def test_counts_and_place(density: str, leaves: int) -> None:
    city = TiledCity(leaves, density, seed=3, sh_degree=0)
    scene = concatenate(list(city.tiles())).validate()
    assert len(scene) == leaves
    # cells whose centres lie in the square reach over its edge; a coarse splat is off its surface
    reach = np.quantile(np.abs(scene.means[:, :2]).max(axis=1), 0.999)
    assert 0.9 * city.half_m <= reach <= city.half_m + 8.0 + DENSITIES[density].cell_m
    assert (np.abs(city.path[:, :2]).max(axis=0) <= [0.8 * city.half_m + 1, 1]).all()


def test_the_same_bits_on_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(city_tiles, "_TILE_LEAVES", 5000)
    city = TiledCity(60_000, "dense", seed=1, sh_degree=1)
    before = parallel.threads()
    try:
        scenes = []
        for count in (1, 3):
            parallel.set_threads(count)
            scenes.append(concatenate(list(city.tiles())))
    finally:
        parallel.set_threads(before)
    for name in FIELDS:
        assert np.array_equal(*(getattr(scene, name) for scene in scenes))
    other = concatenate(list(TiledCity(60_000, "dense", seed=2, sh_degree=1).tiles()))
    assert not np.array_equal(scenes[0].means, other.means)


@pytest.mark.parametrize("density", DENSITIES)
def test_a_larger_city_contains_the_smaller_ones(density: str) -> None:
    sizes = (1000, 20_000, 320_000)
    rows = []
    for leaves in sizes:
        scene = concatenate(list(TiledCity(leaves, density, seed=5, sh_degree=1).tiles()))
        fields = [getattr(scene, name).reshape(leaves, -1) for name in FIELDS]
        rows.append(np.ascontiguousarray(np.concatenate(fields, axis=1)))
    sets = [set(map(bytes, block)) for block in rows]
    assert [len(found) for found in sets] == list(sizes)
    assert sets[0] < sets[1] < sets[2]


def test_tiles_are_small_and_stand_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(city_tiles, "_TILE_LEAVES", 10_000)
    city = TiledCity(200_000, "dense", sh_degree=0)
    tiles = list(city.tiles())
    assert len(tiles) >= 15 and max(len(t) for t in tiles) < 20_000
    boxes = [np.ptp(t.means[:, :2], axis=0) for t in tiles]
    assert np.median([box.min() for box in boxes]) < city.half_m


@pytest.mark.parametrize(("density", "thinner"), [("city", 1.0), ("dense", (32 / 12) ** 2)])
def test_scans_thin_out_away_from_the_street(density: str, thinner: float) -> None:
    """On the carriageway of a side street, which shows alike all along."""
    counts = np.zeros(2)
    for tile in TiledCity(2_000_000, density, sh_degree=0).tiles():
        x, y, z = tile.means.T
        road = (x > 11) & (x < 17) & (np.abs(z) < 0.1)
        counts += [(road & (np.abs(y) > low) & (np.abs(y) < low + 4)).sum() for low in (10, 30)]
    assert counts[0] / counts[1] == pytest.approx(thinner, rel=0.15)


def test_every_town_is_scanned_from_its_own_street() -> None:
    city = TiledCity(1000, "dense")
    shares = []
    for place in ((0, 0), (-2, 3)):
        town = city_tiles._Town.of(city, place)
        cells, patches = town.cells, town.geometry.patches
        flat = cells.patch >= 0
        aside = np.abs(patches.origins[cells.patch[flat], 1] - place[1] * city_tiles.TOWN_M)
        shares.append(town.counts[flat][aside < 8.0].sum() / town.counts.sum())
        # where few splats are expected they still are no larger than what they stand for
        edges = np.sqrt(patches.lengths[cells.patch[flat]].prod(axis=1))
        assert (cells.apart[flat] <= edges * (1 + 1e-12)).all()
    assert shares[0] > 0.5 and shares[1] == pytest.approx(shares[0], rel=0.1)


def test_towns_differ_and_join() -> None:
    city = TiledCity(400_000, "city", sh_degree=0)
    assert city.half_m == pytest.approx(141.4, rel=0.1)  # a town and parts of eight others
    scene = concatenate(list(city.tiles()))
    x, y, _ = scene.means.T
    for low, high in ((-140, -80), (-80, 80), (80, 140)):
        town = (x >= low) & (x < high)
        share = town.sum() / len(scene)
        assert share == pytest.approx((high - low) / (2 * city.half_m), rel=0.15)
        # the main street runs through, with nothing in the way of a walker
        assert not (town & (np.abs(y) < 1) & (scene.means[:, 2] > 0.6)).any()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((999, "city", 0, 0), "leaves must lie in 1000..200000000, not 999"),
        ((5000, "town", 0, 0), "density must be one of city, dense, not 'town'"),
        ((5000, "city", -1, 0), "seed must be an integer >= 0"),
        ((5000, "city", 0, 4), "sh_degree must be 0, 1, 2 or 3"),
    ],
)
def test_bad_values_are_refused(values: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TiledCity(*values)
