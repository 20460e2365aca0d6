"""Time one stereo frame on two accelerators and print both side by side.

python examples/compare_accelerators.py --leaves 100000 --size 1024

`nebula` shares the left eye's work with the right eye; `gscore_nebula` renders each eye alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

from arch import ClientWork, analyse_frame, frame_energy
from gaussians.cameras import Display, StereoRig
from gaussians.errors import InputError
from gaussians.render import render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.synthetic import generate_city
from nebula.hardware import load_accelerator, load_costs, load_technology

ACCELERATORS = ("nebula", "gscore_nebula")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--leaves", type=int, default=100_000, help="Gaussians of the city")
    parser.add_argument("--size", type=int, default=1024, help="pixels per eye, both ways")
    options = parser.parse_args(argv)

    city = generate_city(options.leaves, seed=0)
    rig = StereoRig(Display.from_fov(options.size, options.size, 96.0), city.start)
    count = len(city.scene)  # all held, all drawn, nothing arrives in this frame
    client = ClientWork(count, count, 0, 0, 0, 0)
    table: list[tuple[str, ...]] = [("", "cycles", "ms", "bound by", "DRAM, MB", "mJ")]
    for name in ACCELERATORS:
        config = load_accelerator(name)
        workload = config.workload  # the stereo method and tile test this hardware is built for
        method = replace(PRESETS[workload.stereo_method], intersection=workload.intersection)
        work = render_stereo(city.scene, rig, method, tile_px=workload.tile.edge_px).work
        analysis = analyse_frame(config, work, client)
        timing = analysis.timing
        energy = frame_energy(config, analysis.activity, timing, load_costs(), load_technology())
        numbers = (f"{timing.cycles_per_frame}", f"{timing.frame_ms:.2f}", timing.bound_by)
        numbers += (f"{timing.dram_bytes / 1e6:.1f}", f"{energy.total_mj_per_frame:.2f}")
        table.append((name, *numbers))
    for row in table:
        print(f"{row[0]:14}" + "".join(f"{value:>14}" for value in row[1:]))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
