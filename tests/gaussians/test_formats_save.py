"""Writers by extension, what they refuse, and reads in chunks."""

from __future__ import annotations

import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.formats import fit_scene, iterate_ply, iterate_splat, load_scene, save_scene
from gaussians.formats.files import write_atomically
from gaussians.scene import FIELDS, Scene, concatenate, normalised_quaternions

SUFFIXES = (".ply", ".splat", ".spz")


def scene_of(count: int, degree: int = 0, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    sh = rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3))
    return Scene(
        rng.normal(size=(count, 3)).astype(np.float32),
        normalised_quaternions(rng.normal(size=(count, 4))),
        np.exp(rng.normal(size=(count, 3)) - 3).astype(np.float32),
        rng.random(count).astype(np.float32),
        sh.astype(np.float32),
    )


@given(st.integers(0, 10**6), st.booleans())
@settings(max_examples=30, deadline=None)
def test_splat_round_trip_stays_within_the_stated_errors(tmp_path_factory, seed, axis_aligned):
    scene = scene_of(60, seed=seed)
    if axis_aligned:
        axes = np.random.default_rng(seed).choice([-1, 0, 1], p=[0.1, 0.8, 0.1], size=(60, 4))
        axes[:, seed % 4] = (axes != 0).any(axis=1) * axes[:, seed % 4] + ~(axes != 0).any(axis=1)
        scene = replace(scene, quaternions=normalised_quaternions(axes))
    path = tmp_path_factory.mktemp("splat") / "a.splat"
    save_scene(scene, path)
    assert path.stat().st_size == 32 * 60
    back = load_scene(path)[0]
    for field in ("means", "scales"):
        assert np.array_equal(getattr(back, field), getattr(scene, field))
    assert np.abs(back.opacities - scene.opacities).max() <= 0.00197
    assert 0.2820948 * np.abs(back.sh - scene.sh).max() <= 0.00197
    assert np.abs(back.quaternions - scene.quaternions).max() <= 0.008


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_saved_scene_replaces_the_file_in_one_step(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    save_scene(scene_of(9), str(path))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    back, files = load_scene(str(path))
    assert len(back) == 9
    assert files == [path]
    content = path.read_bytes()
    save_scene(scene_of(9), path)
    assert path.read_bytes() == content
    with pytest.raises(InputError):
        save_scene(replace(scene_of(9), opacities=np.full(9, np.nan, np.float32)), path)
    with pytest.raises(InputError, match="cannot be written"):
        save_scene(scene_of(9), tmp_path / "nowhere" / f"a{suffix}")
    assert path.read_bytes() == content
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_write_that_fails_half_way_leaves_the_old_file(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"old")

    def blocks():
        yield b"new"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, blocks())
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_only_known_extensions_are_written(tmp_path):
    for name in ("a.sog", "a", "a.png", "lod-meta.json"):
        with pytest.raises(InputError, match=r"must be one of \.ply, \.splat, \.spz"):
            save_scene(scene_of(2), tmp_path / name)
        with pytest.raises(InputError, match="must be one of"):
            fit_scene(scene_of(2), tmp_path / name)


def test_splat_names_what_would_be_lost_and_fit_drops_it(tmp_path):
    scene = scene_of(4, degree=2)
    opacities, sh = scene.opacities.copy(), scene.sh.copy()
    opacities[1], sh[2, 0] = 3, [5, -5, 0]
    wild = replace(scene, opacities=opacities, sh=sh)
    path = tmp_path / "a.splat"
    message = "cannot hold 96 harmonics above degree 0, 1 opacities above 1, 2 colours outside 0..1"
    with pytest.raises(InputError, match=message):
        save_scene(wild, path)
    fitted, lost = fit_scene(wild, path)
    assert list(lost.values()) == [96, 1, 2]
    save_scene(fitted, path)
    back = load_scene(path)[0]
    assert back.sh_degree == 0
    assert back.opacities[1] == 1
    colour = 0.5 + 0.28209479 * back.sh[2, 0]
    assert np.allclose(colour, [1, 0, 0.5], atol=0.002)
    assert fit_scene(back, path)[1] == {}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_fit_changes_nothing_that_already_fits(suffix):
    scene = scene_of(50)
    fitted, lost = fit_scene(scene, f"a{suffix}")
    assert lost == {}
    for field in FIELDS:
        assert np.array_equal(getattr(fitted, field), getattr(scene, field)), field


def test_ply_holds_merged_opacities_only_after_fit(tmp_path):
    merged = replace(scene_of(3), opacities=np.float32([0.5, 2, 44]))
    with pytest.raises(InputError, match="opacities must be at most 1"):
        save_scene(merged, tmp_path / "a.ply")
    fitted, lost = fit_scene(merged, tmp_path / "a.ply")
    assert lost == {"opacities above 1": 2}
    save_scene(fitted, tmp_path / "a.ply")
    assert load_scene(tmp_path / "a.ply")[0].opacities.tolist() == [0.5, 1, 1]


@pytest.mark.parametrize("chunk", [1, 7, 20, 21, 1000])
@pytest.mark.parametrize("iterate", [iterate_ply, iterate_splat])
def test_chunks_are_the_whole_scene_in_order(tmp_path, iterate, chunk):
    path = tmp_path / ("a.ply" if iterate is iterate_ply else "a.splat")
    save_scene(scene_of(21, degree=1 if iterate is iterate_ply else 0), path)
    parts = list(iterate(path, chunk))
    assert [len(part) for part in parts[:-1]] == [chunk] * (len(parts) - 1)
    whole, joined = load_scene(path)[0], concatenate(parts)
    for field in FIELDS:
        assert np.array_equal(getattr(joined, field), getattr(whole, field)), field
    with pytest.raises(InputError, match="chunk must be a positive number of Gaussians, not 0"):
        next(iterate(path, 0))


@pytest.mark.parametrize("iterate", [iterate_ply, iterate_splat])
def test_a_chunk_with_an_error_says_where_it_is(tmp_path, iterate):
    path = tmp_path / ("a.ply" if iterate is iterate_ply else "a.splat")
    save_scene(scene_of(20), path)
    content = bytearray(path.read_bytes())
    size = 32 if iterate is iterate_splat else 68
    at = len(content) - 3 * size
    content[at : at + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(content)
    scenes = iterate(path, 8)
    assert [len(next(scenes)) for _ in range(2)] == [8, 8]
    with pytest.raises(InputError, match=r"from Gaussian 16 on: .*(Gaussian|number) 1\b"):
        next(scenes)
    path.write_bytes(content[:-1])
    with pytest.raises(InputError, match=r"truncated|multiple of 32"):
        next(iterate(path, 8))


@pytest.mark.parametrize("iterate", [iterate_ply, iterate_splat])
def test_memory_of_chunked_reads_does_not_grow_with_the_file(tmp_path, iterate):
    path = tmp_path / ("a.ply" if iterate is iterate_ply else "a.splat")
    save_scene(scene_of(200_000), path)
    tracemalloc.start()
    try:
        peaks = []
        for chunk in (2_000, 200_000):
            tracemalloc.reset_peak()
            assert sum(len(scene) for scene in iterate(path, chunk)) == 200_000
            peaks.append(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()
    assert peaks[0] < 2 * 2**20  # the scene itself has 11 MiB
    assert peaks[1] > 20 * peaks[0]


def test_what_is_not_a_regular_file_is_refused_at_once(tmp_path):
    pipe = tmp_path / "a.ply"
    os.mkfifo(pipe)
    for name in ("b.splat", "b.spz", "b.sog", "b.json", "b"):
        (tmp_path / name).symlink_to(pipe)
    for path in tmp_path.iterdir():
        with pytest.raises(InputError, match="must be a regular file"):
            load_scene(path)
    with pytest.raises(InputError, match="must be a regular file"):
        load_scene(Path("/dev/zero"))
