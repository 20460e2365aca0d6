"""Compose the part of a V3DG layout that one of its cameras sees, and render both eyes.

python examples/compose_donut_sea.py $NEBULA_DATA/scenes/donut/DonutSea.json --camera 45

DonutSea holds 2048 copies of one doughnut, 93.4 million Gaussians in all. Only instances that can
touch either eye's window are composed; --instances keeps the nearest N of them, --no-cull composes
all the rest too. One Gaussian takes about 0.3 kB while it is rendered. Lengths are in the layout's
units: a doughnut is 0.2 wide, so at a tenth of a unit per metre 0.006 is 6 cm between the eyes.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaussians.cameras import Display, StereoRig
from gaussians.errors import InputError
from gaussians.formats.layout import read_composition
from gaussians.render import render_stereo
from gaussians.stereo_method import PRESETS
from nebula.images import png


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("layout", type=Path)
    parser.add_argument("--camera", type=int, default=45, help="number in the layout, from 0")
    parser.add_argument("--instances", type=int, help="at most so many, nearest first")
    parser.add_argument("--no-cull", action="store_true", help="compose what is out of view too")
    parser.add_argument("--baseline", type=float, default=0.006)
    parser.add_argument("--near", type=float, default=0.01)
    parser.add_argument("--width", type=int, help="pixels (default: the camera's own)")
    parser.add_argument("--out", type=Path, default=Path("out/sea"))
    options = parser.parse_args(argv)
    try:
        composition, layout, _ = read_composition(options.layout)
        if not 0 <= options.camera < len(layout.cameras):
            raise InputError(f"--camera must lie in 0..{len(layout.cameras) - 1}")
        camera = layout.cameras[options.camera]
        display = _resized(camera.display, options.width or camera.display.width)
        rig = StereoRig(display, camera.pose, options.baseline, options.near)
        cull = composition.visible(rig)
        everything = np.arange(len(composition.instances))
        candidates = everything if options.no_cull else cull.indices
        order = np.argsort(composition.depths(rig)[candidates], kind="stable")
        chosen = np.sort(candidates[order[: options.instances]])
        begin = time.perf_counter()
        scene = composition.compose(chosen)
        composed = time.perf_counter()
        frame = render_stereo(scene, rig, PRESETS["exact"])
    except InputError as error:
        parser.error(str(error))
    rendered = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    for name, image in (("left", frame.left), ("right", frame.right)):
        (options.out / f"camera_{options.camera}_{name}.png").write_bytes(png(image))
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # kB on Linux
    print(f"{len(everything)} instances, {composition.count()} Gaussians in the layout")
    print(f"out of view: {cull.behind_near} behind, {cull.outside} beside; view: {camera.name}")
    print(f"composed: {len(chosen)} instances, {len(scene)} Gaussians, {composed - begin:.1f} s")
    print(f"rendered: {rendered - composed:.1f} s at {display.width} x {display.height} per eye, ")
    print(f"  {frame.visible[0]} and {frame.visible[1]} Gaussians in view; peak {peak_gib:.2f} GiB")


def _resized(display: Display, width: int) -> Display:
    """The same field of view in other pixels."""
    factor = width / display.width
    height = max(1, round(display.height * factor))
    focal = display.fx * factor
    return Display(width, height, focal, focal, width / 2, width / 2, height / 2)


if __name__ == "__main__":
    main()
