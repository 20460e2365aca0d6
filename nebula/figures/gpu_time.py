"""How long a LoD search would take on the paper's server GPU: an analytic model.

What a method does was counted while it ran on the CPU; a *plan* says how a GPU would do the same
work, as streamed bytes, gathered records, node tests, kernel launches and dependent steps. Then

    time = max(streamed / (B s) + gathered x 32 B / (B g),  tests x instructions / (lanes x clock))
           + launches x launch + steps x latency

with bandwidth B, its shares s and g that streams and gathers attain, and one lane for one
instruction per cycle. The first term is a roofline: memory and arithmetic overlap; launches and
dependent steps do not overlap with anything. All constants are in configs/technology/a100.yaml.

*Not modelled*: the 40 MB L2 cache (a small tree would stay in it), divergence inside a warp, row
misses of HBM beyond the gather's share, contention of atomic counters, idle multiprocessors when
there is too little work, and the transfer of the request and of the result between host and device,
the same for every method. The band takes all slow or all fast values together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from arch.provenance import Provenance
from nebula.config import config_path, load_config

Speed = Literal["slow", "point", "fast"]

# Plans of their own for what another method counted: name -> that method
TENSOR_PASSES = "octree_gs, tensor passes"
SUBTREE_ORDER = "temporal, stored by subtree"
VARIANTS = {SUBTREE_ORDER: "temporal", TENSOR_PASSES: "octree_gs"}
_TREELET_LEVELS = 6  # a treelet of 32 to 64 nodes of a binary tree
_ROUNDS = 2  # until no treelet, or no node, asks for another: an assumption, not counted
_HEADER_BYTES, _RECORD_BYTES, _ID_BYTES = 36, 32, 4


_TEXTS = ("source", "reference", "confidence")


@dataclass(frozen=True, kw_only=True)
class _Numbers(Provenance):
    """A group of positive numbers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive(*(f.name for f in fields(self) if f.name not in _TEXTS))


@dataclass(frozen=True, kw_only=True)
class Memory(_Numbers):
    """Of one GPU."""

    bandwidth_gb_s: float


@dataclass(frozen=True, kw_only=True)
class Streaming(_Numbers):
    """Share of the bandwidth that reading in order attains."""

    share: float
    slow: float
    fast: float


@dataclass(frozen=True, kw_only=True)
class Gather(_Numbers):
    """Share of the bandwidth that reading sectors in no order attains."""

    sector_bytes: int
    share: float
    slow: float
    fast: float


@dataclass(frozen=True, kw_only=True)
class Cores(_Numbers):
    """Arithmetic lanes and their clock."""

    lanes: int
    clock_ghz: float


@dataclass(frozen=True, kw_only=True)
class NodeTest(_Numbers):
    """Instructions of one node test, everything around it included."""

    instructions: float


@dataclass(frozen=True, kw_only=True)
class Launch(_Numbers):
    """Microseconds from the end of one kernel to the start of the next."""

    us: float
    slow: float
    fast: float


@dataclass(frozen=True, kw_only=True)
class Step(_Numbers):
    """Cycles of a read that the next one waits for."""

    latency_cycles: float
    slow: float
    fast: float


@dataclass(frozen=True, kw_only=True)
class TensorPasses(_Numbers):
    """The Octree-GS rule as separate array operations."""

    launches: int
    bytes_per_node: float


@dataclass(frozen=True)
class Gpu:
    """configs/technology/a100.yaml."""

    name: str
    memory: Memory
    streaming: Streaming
    gather: Gather
    cores: Cores
    node_test: NodeTest
    launch: Launch
    step: Step
    tensor_passes: TensorPasses


def load_gpu() -> Gpu:
    """The shipped configs/technology/a100.yaml."""
    return load_config(Gpu, config_path("a100", "technology"), "a100")


@dataclass(frozen=True)
class GpuWork:
    """One search as a GPU would do it."""

    streamed_bytes: float
    launches: float
    sectors: float = 0.0  # gathered
    tests: float = 0.0
    steps: float = 0.0  # reads one after the other


def time_us(work: GpuWork, gpu: Gpu, speed: Speed = "point") -> float:
    """Microseconds of one search; see the formula above."""
    streaming, gather, launch, latency = (
        (gpu.streaming.share, gpu.gather.share, gpu.launch.us, gpu.step.latency_cycles)
        if speed == "point"
        else (getattr(g, speed) for g in (gpu.streaming, gpu.gather, gpu.launch, gpu.step))
    )
    bytes_per_us = 1e3 * gpu.memory.bandwidth_gb_s
    memory = work.streamed_bytes / (bytes_per_us * streaming)
    memory += work.sectors * gpu.gather.sector_bytes / (bytes_per_us * gather)
    cycles_per_us = 1e3 * gpu.cores.clock_ghz
    arithmetic = work.tests * gpu.node_test.instructions / (gpu.cores.lanes * cycles_per_us)
    return max(memory, arithmetic) + work.launches * launch + work.steps * latency / cycles_per_us


# ---------------------------------------------------------------- plans


Row = Mapping[str, Any]  # of nebula.search_measurement
Plan = Callable[[Row, int, int, Gpu], GpuWork]  # row, nodes of the tree, its levels, GPU


def plan_work(method: str, row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    """The work of one mean search by a method, from what was counted on the CPU."""
    return PLANS[method][0](row, nodes, levels, gpu)


def _events(row: Row) -> float:
    return _ID_BYTES * float(row["adds_mean"] + row["removes_mean"])


def _flat(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    streamed = row["bytes_touched_mean"] + _events(row)
    return GpuWork(streamed, launches=2, tests=row["nodes_tested_mean"])


def _depth_first(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    tested = row["nodes_tested_mean"]
    streamed = row["bytes_touched_mean"] + _events(row)
    return GpuWork(streamed, launches=2, tests=tested, steps=tested)


def _streaming(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    streamed = row["bytes_touched_mean"] + _events(row)
    return GpuWork(streamed, launches=2, tests=row["nodes_tested_mean"], steps=2 * levels)


def _treelets(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    tested = row["nodes_tested_mean"]
    headers = row["bytes_touched_mean"] - _RECORD_BYTES * tested
    return GpuWork(
        streamed_bytes=headers + _events(row),
        launches=2,
        sectors=tested,
        tests=tested + headers / _HEADER_BYTES,
        steps=_ROUNDS * _TREELET_LEVELS,
    )


def _subtree_order(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    tested = row["nodes_tested_mean"]
    streamed = row["bytes_touched_mean"] + _events(row)
    return GpuWork(streamed, launches=2, tests=tested, steps=2 * _ROUNDS)


def _wheel(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    tested = row["nodes_tested_mean"]
    return GpuWork(
        streamed_bytes=_ID_BYTES * tested + _events(row),
        launches=3 + _ROUNDS,
        sectors=4 * tested,
        tests=tested,
        steps=2 * _ROUNDS,
    )


def _auto(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    streamed = row["bytes_touched_mean"] + _events(row)
    tests = row["nodes_tested_mean"]
    return GpuWork(streamed, launches=3 + _ROUNDS, tests=tests, steps=2 * _ROUNDS)


def _octree_gs(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    streamed = row["bytes_touched_mean"] + _ID_BYTES * row["cut_size_mean"]
    return GpuWork(streamed, launches=1, tests=row["nodes_tested_mean"])


def _tensor_passes(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    passes = gpu.tensor_passes
    streamed = passes.bytes_per_node * nodes + 2 * _ID_BYTES * row["cut_size_mean"]
    return GpuWork(streamed, launches=passes.launches)


def _city_gaussian(row: Row, nodes: int, levels: int, gpu: Gpu) -> GpuWork:
    return GpuWork(row["bytes_touched_mean"], launches=2, tests=row["nodes_tested_mean"])


PLANS: dict[str, tuple[Plan, str]] = {
    "flat": (_flat, "a thread per node, then marks compared with the last ones"),
    "depth_first": (_depth_first, "one thread, every node waits for the one before: no GPU method"),
    "streaming": (
        _streaming,
        "one persistent kernel takes blocks from a queue; per level a read of the queue and one of "
        "the block wait for each other",
    ),
    "temporal": (
        _treelets,
        "a warp per treelet, a sector per record, headers streamed; two rounds of six levels; "
        "leaves are known from their parent",
    ),
    SUBTREE_ORDER: (
        _subtree_order,
        "the same with the records of a treelet side by side, as the paper partitions: all is "
        "streamed, and a treelet arrives in one read",
    ),
    "validity": (_treelets, "all headers streamed, then a warp per treelet that is to be tested"),
    "wheel": (
        _wheel,
        "collect, two rounds of tests, insertion, events; four sectors per test: record, two "
        "marks, new entry",
    ),
    "auto": (
        _auto,
        "as wheel, all bytes streamed: most are of the searches it streams until its wheel is full",
    ),
    "octree_gs": (_octree_gs, "all in one kernel, as on the CPU here"),
    TENSOR_PASSES: (_tensor_passes, "one kernel per array operation, as in tensor libraries"),
    "city_gaussian": (_city_gaussian, "blocks tested, lists copied when one of them changes"),
}
