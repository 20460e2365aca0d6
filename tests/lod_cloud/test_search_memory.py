"""Searching a stored tree holds a fraction of it in memory."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import search_memory
from gaussians.synthetic import generate_city
from lod_cloud import build_tree, save_tree

GIB = 1 << 30


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree of 250 MB on disk."""
    made = generate_city(400_000, 0, sh_degree=3)
    points = [(float(x), float(y), float(z)) for x, y, z in made.path]
    tree = build_tree(made.scene, up=(0.0, 0.0, 1.0), start=points[0], path=tuple(points))
    directory = tmp_path_factory.mktemp("city") / "tree"
    save_tree(tree, directory)
    return directory


@pytest.mark.slow
@pytest.mark.parametrize("method", search_memory.METHODS)
def test_a_search_holds_a_fraction_of_the_tree(city: Path, method: str) -> None:
    """Beside what Python and the kernels need, which the limit allows for."""
    assert search_memory.directory_bytes(city) > 200e6
    found = search_memory.measure(city, method, 40, 4)
    assert found["added"] > 100 and found["cut_size"] > 10_000
    assert found["peak_bytes"] < search_memory.limit_bytes(city)


def test_the_limit_of_a_large_tree_is_two_gibibytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for size, most in ((12 * GIB, 2 * GIB), (8 * GIB, 2 * GIB), (0, 0.5 * GIB)):
        monkeypatch.setattr(search_memory, "directory_bytes", lambda _, size=size: size)
        assert search_memory.limit_bytes(tmp_path) <= most


def test_peak_memory_is_read() -> None:
    assert 10e6 < search_memory.peak_bytes() < 100e9
