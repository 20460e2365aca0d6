"""``python -m benchmarks.render``: how long one stereo frame takes, stage by stage.

Renders `street` (2064 x 2208 per eye) by the stereo method `exact`, on one thread and on two, and
sets the rasteriser beside a kernel that does its arithmetic alone (micro_kernel.py). Times are the
least of several frames, each stage on its own; CPU seconds count all threads. Run it on a quiet
machine: the load average stands in the first line.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks import gsplat_reference, machine, micro_kernel
from gaussians import parallel, render
from gaussians.cameras import StereoRig
from gaussians.scene import Scene
from gaussians.stereo_method import PRESETS
from gaussians.synthetic import BenchmarkView, benchmark_scene
from nebula.config import config_path, load_config

STAGES = {  # function of gaussians.render -> what the table calls its calls, in their order
    "project": ["projection"],
    "row_spans": ["row spans"],
    "fill_colours": ["colour"],
    "tile_lists": ["left lists", "right lists"],
    "rasterise": ["raster, left", "raster, right"],
    "forward": ["forward, merge"],
    "right_features": ["right records"],
}
REST, FRAME = "rest", "frame"
RASTER_CPU_S, RASTER_TO_LIMIT = 0.70, 1.9  # targets; the frame's on two free cores
FRAME_CPU_S, FRAME_WALL_S, SPEED_UP = 3.0, 1.6, 1.8

Times = dict[str, tuple[float, float]]  # stage -> CPU seconds, wall seconds


@contextmanager
def stage_times() -> Iterator[Times]:
    """Times of the stage functions while render.py calls them."""
    times: Times = {}
    originals = {name: getattr(render, name) for name in STAGES}

    def timed(function: Callable[..., Any], labels: list[str]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            label = next(label for label in labels if label not in times)
            cpu, wall = time.process_time(), time.perf_counter()
            result = function(*arguments, **keywords)
            times[label] = time.process_time() - cpu, time.perf_counter() - wall
            return result

        return call

    try:
        for name, labels in STAGES.items():
            setattr(render, name, timed(originals[name], labels))
        yield times
    finally:
        for name, function in originals.items():
            setattr(render, name, function)


def one_frame(scene: Scene, rig: StereoRig, tile_px: int) -> tuple[Times, render.StereoFrame]:
    """The stages of one frame, the rest of it, and all of it."""
    with stage_times() as times:
        cpu, wall = time.process_time(), time.perf_counter()
        frame = render.render_stereo(scene, rig, PRESETS["exact"], tile_px=tile_px)
        whole = time.process_time() - cpu, time.perf_counter() - wall
    stages = [sum(part) for part in zip(*times.values(), strict=True)]
    times[REST] = whole[0] - stages[0], whole[1] - stages[1]
    times[FRAME] = whole
    return times, frame


def measure(
    scene: Scene, rig: StereoRig, tile_px: int, threads: int, repeat: int
) -> tuple[Times, render.StereoFrame]:
    """Least times of ``repeat`` frames after one that does not count."""
    parallel.set_threads(threads)
    one_frame(scene, rig, tile_px)
    frames = [one_frame(scene, rig, tile_px) for _ in range(repeat)]
    least = {
        stage: (min(t[stage][0] for t, _ in frames), min(t[stage][1] for t, _ in frames))
        for stage in frames[0][0]
    }
    return least, frames[-1][1]


def summary(one: Times, two: Times, frame: render.StereoFrame, limit: float) -> dict[str, float]:
    """The figures that have a target, and what they follow from."""
    work = frame.work.left
    raster = one["raster, left"][0]
    return {
        "entries": int(work.processed.sum()),
        "alpha_checks": int(work.alpha_checks.sum()),
        "passes": int(work.passes.sum()),
        "raster_cpu_s": raster,
        "passes_per_s": float(work.passes.sum() / raster),
        "micro_kernel_cpu_s": limit,
        "raster_to_limit": raster / limit,
        "frame_cpu_s": one[FRAME][0],
        "frame_wall_s": two[FRAME][1],
        "speed_up": one[FRAME][1] / two[FRAME][1],
    }


def table(one: Times, two: Times) -> str:
    lines = [f"{'':16}  one thread: CPU s    wall s  two threads: CPU s    wall s"]
    for stage in one:
        numbers = (*one[stage], *two[stage])
        lines.append("{:16}{:19.3f}{:10.3f}{:20.3f}{:10.3f}".format(stage, *numbers))
    return "\n".join(lines)


def verdicts(figures: dict[str, float]) -> str:
    """Every figure that has a target beside it."""
    return "\n".join(
        [
            f"left eye: {figures['entries'] / 1e6:.1f} M list entries, "
            f"{figures['alpha_checks'] / 1e6:.0f} M alpha checks, "
            f"{figures['passes'] / 1e6:.0f} M passes; "
            f"{figures['passes_per_s'] / 1e6:.0f} M passes per CPU second",
            f"raster, one eye: {figures['raster_cpu_s']:.3f} CPU s (target {RASTER_CPU_S:.2f}); "
            f"check and blend alone, as many checks: {figures['micro_kernel_cpu_s']:.3f} CPU s; "
            f"{figures['raster_to_limit']:.2f} times that (target {RASTER_TO_LIMIT}), "
            f"{1 / figures['raster_to_limit']:.0%} of the limit",
            f"frame: {figures['frame_cpu_s']:.2f} CPU s on one thread (target {FRAME_CPU_S}), "
            f"{figures['frame_wall_s']:.2f} s wall on two (target {FRAME_WALL_S}); "
            f"{figures['speed_up']:.2f} times as fast on two (target {SPEED_UP})",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tile", type=int, choices=(4, 8, 16), default=4, help="px (default: 4)")
    parser.add_argument("--repeat", type=int, default=5, help="frames measured (default: 5)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    arguments = parser.parse_args()
    host = machine.describe()
    print(machine.in_words(host))
    view = load_config(BenchmarkView, config_path("street", "scenes"), "street")
    scene, rig = benchmark_scene(view)
    print(f"{view.name}: {len(scene)} splats, tiles of {arguments.tile} px, method exact\n")
    one, frame = measure(scene, rig, arguments.tile, 1, arguments.repeat)
    two, _ = measure(scene, rig, arguments.tile, 2, arguments.repeat)
    checks = int(frame.work.left.alpha_checks.sum())
    figures = summary(one, two, frame, micro_kernel.cpu_seconds(checks, arguments.repeat))
    print(table(one, two), verdicts(figures), sep="\n\n")
    parallel.set_threads(1)
    outside = gsplat_reference.compare(arguments.repeat)
    print(_in_words(outside))
    if arguments.json:
        stages = {"one_thread": one, "two_threads": two}
        result = {"machine": host, "stages": stages, **figures, "gsplat": outside}
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _in_words(outside: dict[str, float] | None) -> str:
    if outside is None:
        return "gsplat's PyTorch reference: skipped, needs the optional extra 'gsplat'"
    size = f"{gsplat_reference.SPLATS} splats, {gsplat_reference.SIZE} px square"
    return (
        f"gsplat's PyTorch reference, {size}: {outside['gsplat_cpu_s']:.3f} CPU s against "
        f"{outside['cpu_s']:.4f}: {outside['ratio']:.0f} times as long "
        f"(images differ by at most {outside['max_abs']:.1g})"
    )


if __name__ == "__main__":
    main()
