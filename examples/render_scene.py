"""Render a scene file into two PNG files, one per eye.

python examples/render_scene.py statue.sog --up=-y --view 0,-0.3,3.2:0,0.1,0 --out out/statue

Any format of docs/formats.md will do; without --view the whole scene is framed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from gaussians.cameras import Display, StereoRig
from gaussians.errors import InputError
from gaussians.formats import load_scene
from gaussians.placement import Placement, parse_view
from gaussians.render import render_stereo
from gaussians.stereo_method import PRESETS
from nebula.images import png


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--up", default="-y", help="the scene's vertical, such as -y or +z")
    parser.add_argument("--view", help="EX,EY,EZ:LX,LY,LZ: eye and look-at point, scene units")
    parser.add_argument("--units-per-metre", type=float, default=1.0)
    parser.add_argument("--near", type=float, default=0.2, help="metres")
    parser.add_argument("--width", type=int, default=1024, help="pixels, both ways")
    parser.add_argument("--out", type=Path, default=Path("out/render"))
    options = parser.parse_args(argv)
    try:
        scene, _ = load_scene(options.scene)  # units of the file
        view = None if options.view is None else parse_view(options.view)
        placement = Placement(options.up, options.units_per_metre, view, options.near)
        pose = placement.view_pose(scene)  # metres, from here on
        scene = scene.scaled(1.0 / options.units_per_metre)
        display = Display.from_fov(options.width, options.width, 96.0)
        rig = StereoRig(display, pose, baseline_m=0.06, near_m=options.near)
        frame = render_stereo(scene, rig, PRESETS["exact"])
    except InputError as error:
        parser.error(str(error))
    options.out.mkdir(parents=True, exist_ok=True)
    for name, image in (("left", frame.left), ("right", frame.right)):
        (options.out / f"{name}.png").write_bytes(png(image))
    print(f"{len(scene)} Gaussians; {frame.visible[0]} seen by the left eye, {frame.visible[1]} by")
    print(f"the right one; {options.out / 'left.png'}, {options.out / 'right.png'}")


if __name__ == "__main__":
    main()
