"""Where kernels compute in float64, and that they do so nowhere else.

One float64 constant or counter promotes an expression under numba but not under NumPy, and the
same image has other bits from then on. So the kernels are run once on something small, and their
types are read.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import pytest

from gaussians.number_formats import FORMATS, rasterise_in_format
from gaussians.projection import project
from gaussians.render import render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.synthetic import generate_city
from gaussians.tiling import TileGrid, row_spans, tile_lists
from lod_cloud import Client, Cloud, CompactCodec, SearchRequest, build_tree, prove_nesting
from lod_cloud.search import SEARCHES, OctreeGsSearch, SearchTree, make_search
from nebula import simulate
from nebula.options import SimulateOptions, scene_options
from tests.kernel_types import float64_variables, is_inlined, project_kernels
from tests.strategies import build_case, small_rig

pytestmark = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="needs numba's compiler"
)

# Kernels that may use float64, and why; every other kernel may not.
FLOAT64 = {
    "gaussians.projection._project": "the determinant and the conic's quotients (conventions.md)",
    "gaussians.projection._threshold": "the logarithm of the threshold, rounded up once",
    "gaussians.footprints": "binning is geometry in float64, conservative by a stated bound",
    "gaussians.tiling._row_ranges": "same",
    "gaussians.tiling._row_entries": "same",
    "gaussians.tiling._column_span": "same",
    "gaussians.synthetic": "scenes are generated in float64 and rounded once",
    "lod_cloud.codec.positions._complete": "steps are powers of two; means are rounded once",
    "lod_cloud.criterion._count_violations": "places the proof's cameras, then rounds them",
    "lod_cloud.harmonics": "parents are merged in float64 and rounded once",
    "lod_cloud.merge": "same; sizes are rounded up",
    "lod_cloud.moments": "same",
    "lod_cloud.nodes": "masses of nodes, and sizes of leaves, rounded up",
    "lod_cloud.pacing_kernels._error": "what is sent first; decides about no node",
    "lod_cloud.pacing_kernels.expand_first": "passes the camera on to it; budgets are float64",
    "lod_cloud.pairing": "costs of merging, and the moments that merge",
    "lod_cloud.siblings": "clients merge as the builder does",
    "lod_cloud.spheres": "sizes in float64, rounded up",
    "lod_cloud.search.sectors": "bounds on the camera's way; no decision is taken with them",
    "lod_cloud.search.treelets._margin": "how long a decision holds, by a stated bound",
    "lod_cloud.search.treelets._is_valid": "compares with those margins",
    "lod_cloud.search.treelets._test_below": "keeps those margins; decisions are float32",
    "lod_cloud.search.treelets.search_treelets": "same",
    "lod_cloud.search.wheel_buckets": "when an entry is due, by a stated bound",
    "lod_cloud.search.wheel_decisions.settle": "makes those entries; decisions are float32",
}
# Of these, where float32 matters beside float64: the float64 variables by name.
NAMES = {
    "gaussians.projection._project": {"det", "wide_xx", "wide_xy", "wide_yy"},
    "lod_cloud.pacing_kernels.expand_first": {"cx", "cy", "cz", "limit_nodes"},
    "lod_cloud.search.treelets._test_below": {"least"},
    "lod_cloud.search.treelets.search_treelets": {"balls", "holds", "least"},
    "lod_cloud.search.wheel_decisions.settle": {"hands", "rates"},
    "lod_cloud.criterion._count_violations": {
        *("ax", "ay", "az", "sx", "sy", "sz", "length", "away", "cameras"),
    },
}


def declared(name: str) -> bool:
    return any(name == entry or name.startswith(f"{entry}.") for entry in FLOAT64)


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Every kernel of the project, after a run of the main job and of what it leaves out."""
    scene = scene_options(None, {"city_leaves": 1500, "width": 48, "height": 48})
    for method in ("exact", "paper", "independent"):
        options = SimulateOptions(
            scene=scene,
            seed=0,
            frames=2,
            method=method,
            tau_px=6.0,
            search_every=1,
            accelerator="nebula",
            rate_mbps=100.0,
            latency_ms=0.0,
            baseline_m=0.06,
            trace_fov=False,
            out=tmp_path_factory.mktemp("out"),
            html=False,
        )
        simulate.run(options)
    prove_nesting(build_tree(generate_city(1500, 0).scene))
    _render_otherwise()
    _search_otherwise()
    _stream_otherwise()
    return project_kernels()


def _render_otherwise() -> None:
    """What `simulate` does not do: other number formats, a stereo buffer that spills."""
    case = build_case([("ordinary", 0)], small_rig())
    render_stereo(case.scene, case.rig, replace(PRESETS["paper"], out_of_range="spill"))
    grid = TileGrid(case.rig.display.width, case.rig.display.height, 4)
    splats = project(case.scene, case.rig)
    lists = tile_lists(row_spans(splats, grid), 0)
    for number_format in FORMATS.values():
        rasterise_in_format(number_format, splats.features[0], lists, grid)


def _search_otherwise() -> None:
    """Every search, first and incremental, with a change of settings."""
    tree = SearchTree.of(build_tree(generate_city(1500, 0).scene))
    for name in SEARCHES:
        search = make_search(name, tree, hysteresis=0.01)
        for step in range(60):
            result = search.search(SearchRequest((0.05 * step, 0, 2), 900.0, 3.0 + (step == 30)))
            assert len(result.cut) == result.cut_size and len(result.added) >= 0
    OctreeGsSearch(tree).select(SearchRequest((0, 0, 2), 900.0, 6.0))


def _stream_otherwise() -> None:
    """A byte budget, and the codec `simulate` does not use, there and back."""
    tree = build_tree(generate_city(1500, 0).scene)
    cloud = Cloud(tree, CompactCodec.train(tree, 0), budget_bytes=500)
    client = Client()
    client.receive(cloud.session_start())
    for step in range(40):
        x = 0.1 * step + 200.0 * (step // 10 % 2)
        client.receive(cloud.search(SearchRequest((x, 0, 2), 900.0, 3.0), 4 * step))
        cloud.receive(client.report())
    assert cloud.stats is not None and cloud.stats.message_bytes <= 500


@pytest.fixture(scope="module")
def found(kernels: dict[str, Any]) -> dict[str, dict[str, str]]:
    """float64 variables of every kernel that declares none, or declares them by name.

    Compiling a caller anew gives its callees their signatures, so callees are looked at last.
    """
    open_ones = {
        n: k for n, k in kernels.items() if n in NAMES or not (declared(n) or is_inlined(k))
    }
    variables: dict[str, dict[str, str]] = {}
    while ready := [n for n, k in open_ones.items() if n not in variables and k.signatures]:
        variables |= {name: float64_variables(open_ones[name]) for name in ready}
    assert sorted(set(open_ones) - set(variables)) == [], "kernels that the run above does not call"
    return variables


def test_float64_stands_only_where_it_is_declared(found: dict[str, dict[str, str]]) -> None:
    assert len(found) >= 10
    assert {n: variables for n, variables in found.items() if variables and n not in NAMES} == {}


@pytest.mark.parametrize("name", NAMES)
def test_declared_float64_has_these_names(found: dict[str, dict[str, str]], name: str) -> None:
    assert {v for v in found[name] if not v.startswith("line ")} == NAMES[name]


def test_what_is_declared_exists(kernels: dict[str, Any]) -> None:
    for entry in FLOAT64:
        assert any(name == entry or name.startswith(f"{entry}.") for name in kernels), entry
