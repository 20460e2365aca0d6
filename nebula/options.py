"""What the commands are asked to do, as plain values; light to import.

``SceneConfig`` is what a file in configs/scenes/ may say, ``SceneOptions`` what a command works
with after file, command line and defaults have been put together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gaussians.cameras import DISPLAYS, Display
from gaussians.errors import InputError
from nebula.config import config_path, data_path, load_dataclass, load_yaml

if TYPE_CHECKING:
    from gaussians.synthetic import BenchmarkView

UP_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
GENERATED_TRACES = ("stand", "walk", "flight", "teleport")
_BENCHMARK_KEY = "spacing_px"  # only a benchmark view has it
CITY_LEAVES = 300_000
WIDTH_PX = HEIGHT_PX = 1024
FOV_DEG = 96.0
NEAR_M = 0.2


@dataclass(frozen=True)
class GeneratedCity:
    """A scene made by the city generator."""

    city: int  # leaves


@dataclass(frozen=True)
class SceneConfig:
    """One file of configs/scenes/: a scene and how to stand in it. None: the default applies.

    Files of ``scene`` and ``trace`` are relative to ``$NEBULA_DATA``.
    """

    scene: str | GeneratedCity | None = None
    level: int | None = None
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    units_per_metre: float | None = None
    view: str | None = None  # EX,EY,EZ:LX,LY,LZ
    near_m: float | None = None
    fov_deg: float | None = None
    display: str | None = None
    width: int | None = None
    height: int | None = None
    trace: str | None = None

    def __post_init__(self) -> None:
        if self.display is not None and (self.width or self.height or self.fov_deg):
            raise InputError("display fixes width, height and fov_deg; give one or the other")


@dataclass(frozen=True)
class SceneOptions:
    """Which scene, where in it, seen through which display, moving how."""

    scene: Path | GeneratedCity | BenchmarkView
    level: int | None  # of a scene with levels, 0 = finest; None for other scenes
    up: str | None  # None: -y for files, +z for the city
    units_per_metre: float
    view: str | None  # None: framed automatically
    near_m: float
    display: Display
    trace: str  # one of GENERATED_TRACES, or a file


@dataclass(frozen=True)
class SimulateOptions:
    """``nebula simulate``: the whole line from scene to report."""

    scene: SceneOptions
    seed: int
    frames: int
    method: str | None  # None: the accelerator's own
    tau_px: float
    search_every: int
    accelerator: str
    rate_mbps: float
    latency_ms: float
    baseline_m: float
    trace_fov: bool  # off-axis display from the recording's half-angles
    out: Path
    html: bool
    paced: bool = False  # messages within what the link carries between two searches


@dataclass(frozen=True)
class RenderOptions:
    """``nebula render``: one stereo frame as PNG files."""

    scene: SceneOptions
    seed: int
    method: str
    baseline_m: float
    out: Path


@dataclass(frozen=True)
class VerifyOptions:
    """``nebula verify``: the right eye by stereo methods against an independent one."""

    scene: SceneOptions
    seed: int
    baseline_m: float
    moving: bool  # along the scene's trace; else the view alone
    frames: int
    mode: Literal["ladder", "isolate", "hostile"] | None
    methods: tuple[str, ...]  # without a mode; see gaussians.stereo_method.parse_method
    tile_px: int
    out: Path


@dataclass(frozen=True)
class InfoOptions:
    """``nebula info``: what is in a scene or a tree."""

    scene: SceneOptions
    seed: int
    verify: bool = False  # every byte of a tree


@dataclass(frozen=True)
class ConvertOptions:
    """``nebula convert``: a scene file to another one, all lengths in file units."""

    scene: SceneOptions  # file, level, old vertical; view and display count for decimation only
    out: Path
    crop: str | None  # X0,Y0,Z0:X1,Y1,Z1
    decimate_tau_px: float | None
    sh_degree: int | None
    new_up: str | None  # None: the scene is not turned
    clamp: bool


@dataclass(frozen=True)
class TiledTree:
    """One file of configs/trees/: a generated city too large for memory, and what is expected of
    its tree.
    """

    leaves: int
    density: Literal["city", "dense"]
    sh_degree: int = 3
    expected: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class BuildTreeOptions:
    """``nebula build-tree``: a scene to a tree directory."""

    scene: SceneOptions
    seed: int
    out: Path
    tiled: TiledTree | None = None  # instead of the scene
    pair_within: int = 16
    fan_out_ratio: float = 1.0
    structure: Literal["merged", "blocks", "instances", "octree"] = "merged"


@dataclass(frozen=True)
class SearchOptions:
    """``nebula search``: LoD searches along a trace in a stored tree."""

    tree: Path
    scene: SceneOptions  # only view, display and trace count
    frames: int | None  # None: enough for 450 searches and those that are not counted
    tau_px: float
    search_every: int
    seed: int
    method: str  # one of nebula.search.METHODS
    compare: bool  # all methods, not only that one
    hysteresis: float


@dataclass(frozen=True)
class StreamOptions:
    """``nebula stream``: a trace through cloud, link and client, without rendering."""

    tree: Path | None  # None: the tree of the scene
    scene: SceneOptions
    seed: int
    frames: int | None  # None: enough for 450 searches
    tau_px: float
    search_every: int
    method: str  # one of lod_cloud.search.SEARCHES
    hysteresis: float
    codec: Literal["paper", "compact"]
    rate_mbps: float
    latency_ms: float
    paced: bool
    loss: float  # share of the messages, either way; likewise the others
    reorder: float
    corruption: float


@dataclass(frozen=True)
class AreaOptions:
    """``nebula area``: the silicon area of an accelerator."""

    accelerator: str
    node_nm: float
    technology: Literal["deepscaletool", "stillmaker_baas", "none"]


@dataclass(frozen=True)
class EnergyOptions:
    """``nebula energy``: the cost table, and the parts of a finished run."""

    report: Path | None


@dataclass(frozen=True)
class FigureOptions:
    """``nebula figure``: one figure, of the scene the command line names or of its own few."""

    name: str
    config: str | None
    given: Mapping[str, Any]  # as for ``scene_options``; without a scene it places the figure's own
    seed: int
    baseline_m: float
    out: Path
    # of figures that search a tree; None: not given, the figure's own choice
    tree: Path | None = None
    tau_px: float | None = None
    search_every: int | None = None
    frames: int | None = None
    shrink: int | None = None  # pictures are 1 / shrink of the display, each way


def scene_options(
    config: str | None, given: Mapping[str, Any], *, default_display: str | None = None
) -> SceneOptions:
    """Command line over configuration file over defaults.

    Parameters
    ----------
    config : a shipped name of configs/scenes/ or a YAML file; None for no file.
    given : values by field of ``SceneConfig``, and ``city_leaves``; None where the command line is
        silent. ``scene`` and ``trace`` are relative to the current folder.
    default_display : preset where neither says anything of the display; None: 1024 x 1024, 96
        degrees.

    Raises InputError for a file that is not there and for values that contradict each other.
    """
    given = {key: value for key, value in given.items() if value is not None}
    if "city_leaves" in given:
        if "scene" in given:
            raise InputError("--scene and --city-leaves exclude each other; give one of them")
        given["scene"] = GeneratedCity(given["city_leaves"])
    path = None if config is None else config_path(config, "scenes")
    mapping = {} if path is None else load_yaml(path)
    benchmark = None
    if path is not None and _BENCHMARK_KEY in mapping:
        benchmark, file = _benchmark(mapping, path.stem)
    else:
        file = load_dataclass(SceneConfig, mapping, "" if path is None else path.stem)
    chosen = {f.name: given.get(f.name, getattr(file, f.name)) for f in fields(SceneConfig)}
    scene, trace = chosen["scene"], chosen["trace"] or "walk"
    if isinstance(scene, str):
        scene = Path(scene) if "scene" in given else data_path(scene, f"{path}: scene")
    if trace not in GENERATED_TRACES and "trace" not in given:
        trace = str(data_path(trace, f"{path}: trace"))
    return SceneOptions(
        scene=scene or benchmark or GeneratedCity(CITY_LEAVES),
        level=chosen["level"],
        up=chosen["up"],
        units_per_metre=_default(chosen["units_per_metre"], 1.0),
        view=chosen["view"],
        near_m=_default(chosen["near_m"], NEAR_M),
        display=_display(given, file, default_display),
        trace=trace,
    )


def tiled_tree(name: str, leaves: int | None, sh_degree: int | None) -> TiledTree:
    """A shipped name of configs/trees/ or a YAML file, with what is given put in its place."""
    path = config_path(name, "trees")
    tree = load_dataclass(TiledTree, load_yaml(path), path.stem)
    return replace(
        tree,
        leaves=_default(leaves, tree.leaves),
        sh_degree=_default(sh_degree, tree.sh_degree),
    )


def parse_up_change(text: str) -> tuple[str, str]:
    """``FROM:TO``, two of ``UP_AXES``; anything else is an InputError."""
    old, _, new = text.partition(":")
    if old not in UP_AXES or new not in UP_AXES:
        raise InputError(
            f"--up must be FROM:TO with two of {', '.join(UP_AXES)}, such as -y:+z, not '{text}'"
        )
    return old, new


def _benchmark(mapping: dict[str, Any], name: str) -> tuple[BenchmarkView, SceneConfig]:
    """A benchmark view of configs/scenes/, and what it says of display and near plane."""
    from gaussians.synthetic import BenchmarkView

    view = load_dataclass(BenchmarkView, mapping, name)
    return view, SceneConfig(display=view.display, near_m=view.near_m)


def _display(given: Mapping[str, Any], file: SceneConfig, default: str | None) -> Display:
    """A preset, or width, height and field of view; the command line's kind replaces the file's."""
    names = ("width", "height", "fov_deg")
    sized = [name for name in names if name in given]
    if "display" in given and sized:
        raise InputError(
            f"--display {given['display']} fixes {', '.join(sized)}; give one or the other"
        )
    sized_by_file = any(getattr(file, name) is not None for name in names)
    preset = given.get("display") or (None if sized else file.display)
    if preset is None and not sized and not sized_by_file:
        preset = default
    if preset is not None:
        if preset not in DISPLAYS:
            raise InputError(f"display must be one of {', '.join(DISPLAYS)}, not '{preset}'")
        return DISPLAYS[preset]
    width, height, fov_deg = (
        _default(given.get(name, getattr(file, name)), value)
        for name, value in zip(names, (WIDTH_PX, HEIGHT_PX, FOV_DEG), strict=True)
    )
    return Display.from_fov(width, height, fov_deg)


def _default(value: Any, default: Any) -> Any:
    return default if value is None else value
