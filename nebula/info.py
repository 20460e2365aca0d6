"""``nebula info``: what is in a scene, or in a tree directory."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import OPACITY_MIN
from gaussians.errors import InputError
from gaussians.placement import auto_view
from gaussians.scene import Scene
from lod_cloud import LodTree, load_tree, prove_nesting, verify_tree
from nebula.options import InfoOptions
from nebula.output import CommandResult
from nebula.progress import progress
from nebula.scene_input import SceneInput, describe_files, load

_PERCENTILES = (0, 1, 50, 99, 100)
_BINS = 10
_BAR = 40  # characters of the longest bar
_OUTLIER_BOXES = 10.0  # an outlier lies outside the 1-99 % box blown up by this about its centre
_NEEDLE_RATIOS = (100.0, 1e4)  # largest by smallest standard deviation
_NEAR_SHARE = 1 / 50  # suggested near plane by the distance to what is looked at
_NEAR_LIMIT_M = 0.2
INTERIOR = {"merged": "merged from their children", "given": "given, not merges of their children"}
_NODE_BYTES = 24  # parent, first child, child count, R, e, leaf id

Float64 = NDArray[np.float64]


def run(options: InfoOptions) -> CommandResult:
    """A scene in metres: counts, harmonics, bounds, distributions, oddities, where to look from.

    For a directory with a ``tree.json``: the tree's shape, its size, and whether it is nested.
    """
    source = options.scene.scene
    if isinstance(source, Path) and (source / "tree.json").is_file():
        return _tree(source, options)
    if options.verify:
        raise InputError("--verify checks a tree directory; the scene is none")
    place = load(options.scene, options.seed)
    data = _describe(place)
    return CommandResult(data, _text(data))


# ---------------------------------------------------------------- a scene


def _describe(place: SceneInput) -> dict[str, Any]:
    scene = place.scene
    means = scene.means.astype(np.float64)
    largest = scene.scales.max(axis=1).astype(np.float64)
    opacities = scene.opacities.astype(np.float64)
    bounds = np.percentile(means, _PERCENTILES, axis=0)
    return {
        "scene": place.name,
        "splats": len(scene),
        "sh_degree": scene.sh_degree,
        "sh_nonzero": _harmonics(scene),
        "up": place.placement.up,
        "percentiles": list(_PERCENTILES),
        "position_m": bounds.tolist(),
        "opacity": np.percentile(opacities, _PERCENTILES).tolist(),
        "largest_scale_m": np.percentile(largest, _PERCENTILES).tolist(),
        "opacity_histogram": _opacity_histogram(opacities),
        "scale_histogram": _scale_histogram(largest),
        "oddities": _oddities(scene, means, bounds[1], bounds[3]),
        **_views(place),
        "memory_bytes": _memory(scene),
        "inputs": describe_files(place.files),
    }


def _harmonics(scene: Scene) -> dict[str, float]:
    """Shares among the coefficients above degree 0 and among the Gaussians; 0 where none exist."""
    above = scene.sh[:, 1:] != 0
    if not above.size:
        return {"coefficients": 0.0, "splats": 0.0}
    return {
        "coefficients": float(above.mean()),
        "splats": float(above.any(axis=(1, 2)).mean()),
    }


def _opacity_histogram(opacities: Float64) -> dict[str, Any]:
    """Ten bins from 0 to 1, the last one with 1 itself; above 1 and never drawn apart."""
    counts, edges = np.histogram(opacities, _BINS, (0.0, 1.0))
    return {
        "edges": edges.tolist(),
        "counts": counts.tolist(),
        "above_one": int(np.count_nonzero(opacities > 1)),
        "never_drawn": int(np.count_nonzero(opacities < OPACITY_MIN)),
    }


def _scale_histogram(largest: Float64) -> dict[str, Any]:
    """Ten bins of equal ratio over all largest standard deviations but 0, which are apart."""
    logarithms = np.log10(largest[largest > 0])
    edges = np.histogram_bin_edges(logarithms, _BINS)
    counts, _ = np.histogram(logarithms, edges)
    return {
        "edges_m": (10.0**edges).tolist(),
        "counts": counts.tolist(),
        "zero": len(largest) - len(logarithms),
    }


def _oddities(scene: Scene, means: Float64, low: Float64, high: Float64) -> dict[str, int]:
    """Counts of what strains a renderer. ``low`` and ``high`` are the 1-99 % box."""
    centre, reach = (low + high) / 2, _OUTLIER_BOXES * (high - low) / 2
    smallest, largest = scene.scales.min(axis=1), scene.scales.max(axis=1).astype(np.float64)
    solid = smallest > 0
    needles = [int(np.count_nonzero(solid & (largest > r * smallest))) for r in _NEEDLE_RATIOS]
    return {
        "outliers": int(np.count_nonzero((np.abs(means - centre) > reach).any(axis=1))),
        "needles_100": needles[0],
        "needles_10000": needles[1],
        "some_scale_zero": int(np.count_nonzero(~solid)),
        "all_scales_zero": int(np.count_nonzero(largest == 0)),
    }


def _views(place: SceneInput) -> dict[str, Any]:
    """The first view and a suggested one; both None for a scene without extent (one point)."""
    try:
        first, suggested = place.view, _suggestion(place)
    except InputError:
        return {"view": None, "suggested": None}
    forward = first.rotation[:, 2].tolist()
    return {
        "view": {"eye_m": first.position.tolist(), "forward": forward},
        "suggested": suggested,
    }


def _suggestion(place: SceneInput) -> dict[str, Any]:
    """``--view`` (file units) that frames the bulk, and ``--near`` (metres) for it.

    The near plane is 1/50 of the distance from that eye to the centre of the 1-99 % box, at most
    0.2 m. Coordinates are rounded to less than a thousandth of that distance.
    """
    units = place.placement.units_per_metre
    eye, target = (np.array(p) for p in auto_view(place.scene, place.placement.up))
    distance_m = float(np.linalg.norm(eye - target))
    decimals = max(0, 3 - math.floor(math.log10(units * distance_m)))
    ends = np.round(units * np.stack([eye, target]), decimals) + 0.0  # no -0
    view = ":".join(",".join(f"{c:.{decimals}f}" for c in end) for end in ends)
    return {"view": view, "near_m": min(_NEAR_LIMIT_M, _NEAR_SHARE * distance_m)}


def _memory(scene: Scene) -> dict[str, int]:
    """Bytes of the scene as float32 records, and of its tree of 2N - 1 nodes."""
    record = 4 * (11 + scene.sh.shape[1] * scene.sh.shape[2])
    nodes = 2 * len(scene) - 1
    return {
        "record": record,
        "scene": record * len(scene),
        "tree": (record + _NODE_BYTES) * nodes,
    }


def _text(data: dict[str, Any]) -> str:
    bounds = np.array(data["position_m"])
    rows = [(f"{axis}, m", bounds[:, i]) for i, axis in enumerate("xyz")]
    rows += [("opacity", data["opacity"]), ("largest scale, m", data["largest_scale_m"])]
    nonzero, odd, memory = data["sh_nonzero"], data["oddities"], data["memory_bytes"]
    opacity, scale, suggested = (
        data["opacity_histogram"],
        data["scale_histogram"],
        data["suggested"],
    )
    lines = [
        f"{data['scene']}: {data['splats']} Gaussians, spherical harmonics of degree "
        f"{data['sh_degree']}, up {data['up']}",
        f"harmonics above degree 0: {nonzero['coefficients']:.1%} of the coefficients are not 0, "
        f"in {nonzero['splats']:.1%} of the Gaussians",
        f"{'':18}" + "".join(f"{f'{p} %':>11}" for p in _PERCENTILES),
        *(f"{name:18}" + "".join(f"{v:11.4g}" for v in values) for name, values in rows),
        "",
        f"opacity ({opacity['above_one']} above 1, {opacity['never_drawn']} below 1/255)",
        *_bars(opacity["edges"], opacity["counts"]),
        f"largest scale, m ({scale['zero']} are 0)",
        *_bars(scale["edges_m"], scale["counts"]),
        "",
        f"outliers: {odd['outliers']} means outside {_OUTLIER_BOXES:g} times the 1-99 % box",
        f"needles: {odd['needles_100']} longer than 100 times their thickness, "
        f"{odd['needles_10000']} than 10000 times; "
        f"{odd['some_scale_zero']} without thickness, {odd['all_scales_zero']} points",
        f"memory: {memory['scene'] / 1e6:.1f} MB ({memory['record']} B each), "
        f"its tree about {memory['tree'] / 1e6:.1f} MB",
    ]
    if data["view"] is None:
        return "\n".join([*lines, "first view: none, the scene has no extent to frame"])
    eye, look = (", ".join(f"{c:.3g}" for c in data["view"][k]) for k in ("eye_m", "forward"))
    lines.append(f"first view: from ({eye}) m towards ({look})")
    lines.append(
        f"to see all of it: --view {suggested['view']} --near {suggested['near_m']:.2g} "
        "(1/50 of the distance, at most 0.2 m)"
    )
    return "\n".join(lines)


def _bars(edges: Sequence[float], counts: Sequence[int]) -> list[str]:
    """One line per bin; the fullest has a bar of 40 characters, every other one that is not
    empty at least one character."""
    most = max(*counts, 1)
    return [
        f"  {low:8.3g} .. {high:<8.3g} {count:>9}  {'#' * -(-_BAR * count // most)}".rstrip()
        for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
    ]


# ---------------------------------------------------------------- a tree


def _tree(source: Path, options: InfoOptions) -> CommandResult:
    scene = options.scene
    if scene.level is not None or scene.up is not None or scene.units_per_metre != 1.0:
        raise InputError(
            f"{source}: a tree knows its up axis and units; give no --level, --up, ..."
        )
    with progress(f"reading {source}"):
        tree = verify_tree(source) if options.verify else load_tree(source)
    with progress("proving nesting"):
        violations = prove_nesting(tree)
    data = _describe_tree(tree, source, violations) | {"verified": options.verify}
    return CommandResult(data, _tree_text(data))


def _describe_tree(tree: LodTree, source: Path, violations: int) -> dict[str, Any]:
    nodes = np.bincount(tree.child_count)
    metadata = tree.metadata
    sizes = {file.name: file.stat().st_size for file in sorted(source.iterdir()) if file.is_file()}
    above_one = int(np.count_nonzero((tree.gaussians.opacities > 1) & (tree.child_count > 0)))
    return {
        "tree": str(source),
        "nodes": len(tree),
        "leaves": int(nodes[0]),
        "levels": tree.levels,
        **_level_columns(tree),
        "fan_out": {str(k): int(n) for k, n in enumerate(nodes) if n},
        "fan_out_max": len(nodes) - 1,
        "sh_degree": tree.sh_degree,
        "interior": metadata.build.get("interior", "given"),
        "opacities_above_one": above_one,
        "opacities_above_one_share": above_one / max(len(tree) - int(nodes[0]), 1),
        "bytes_on_disk": sum(sizes.values()),
        "bytes_of_files": sizes,
        "nesting_violations": violations,
        "bounds_m": metadata.bounds,
        "up": metadata.up,
        "units_per_metre": metadata.units_per_metre,
        "start_m": metadata.start,
        "build": metadata.build,
    }


def _level_columns(tree: LodTree) -> dict[str, list[Any]]:
    """One entry per level: its nodes, its leaves, the median extent e of its nodes."""
    levels = [slice(*bounds) for bounds in itertools.pairwise(tree.level_offsets.tolist())]
    return {
        "level_nodes": [level.stop - level.start for level in levels],
        "level_leaves": [int(np.count_nonzero(tree.child_count[level] == 0)) for level in levels],
        "level_median_extent_m": [float(np.median(tree.extent[level])) for level in levels],
    }


def _tree_text(data: dict[str, Any]) -> str:
    inner = data["nodes"] - data["leaves"]
    children = (data["nodes"] - 1) / max(inner, 1)
    checked = "every byte matches its checksum" if data["verified"] else "sizes match"
    lines = [
        f"{data['tree']}: {data['nodes']} nodes, {data['leaves']} leaves, {data['levels']} levels, "
        f"spherical harmonics of degree {data['sh_degree']}",
        f"interior nodes: {INTERIOR[data['interior']]}; opacity above 1 in "
        f"{data['opacities_above_one']} of {inner} ({data['opacities_above_one_share']:.1%})",
        *_level_lines(data),
        f"children per interior node: {children:.2f}, at most {data['fan_out_max']}",
        *_fan_out_lines({int(k): n for k, n in data["fan_out"].items()}),
        f"on disk: {data['bytes_on_disk'] / 1e6:.1f} MB; {checked}",
        *(f"  {name:18} {size:>14} B" for name, size in data["bytes_of_files"].items()),
        f"built by: {', '.join(f'{k} {v}' for k, v in data['build'].items())}",
        f"nesting: {data['nesting_violations']} violations on {data['nodes'] - 1} edges",
    ]
    return "\n".join(lines)


def _level_lines(data: dict[str, Any]) -> list[str]:
    columns = (data[f"level_{name}"] for name in ("nodes", "leaves", "median_extent_m"))
    return [
        f"{'level':>7} {'nodes':>11} {'leaves':>11}  median extent, m",
        *(
            f"{level:>7} {nodes:>11} {leaves:>11}  {extent:.4g}"
            for level, (nodes, leaves, extent) in enumerate(zip(*columns, strict=True))
        ),
    ]


def _fan_out_lines(fan_out: dict[int, int]) -> list[str]:
    """A bar for 0, 1, 2, 3, 4, 5-8, 9-16, ... children."""
    bins: dict[tuple[int, int], int] = {}
    for children, nodes in fan_out.items():
        high = children if children <= 4 else 1 << (children - 1).bit_length()
        key = (high if high <= 4 else high // 2 + 1, high)
        bins[key] = bins.get(key, 0) + nodes
    most = max(bins.values())
    lines = []
    for (low, high), count in bins.items():
        name = str(low) if low == high else f"{low}-{high}"
        lines.append(f"  {name:>9} {count:>11}  {'#' * -(-_BAR * count // most)}")
    return lines
