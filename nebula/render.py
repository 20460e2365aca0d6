"""``nebula render``: one stereo frame of a scene as PNG files."""

from __future__ import annotations

from typing import Any

from gaussians.cameras import StereoRig
from gaussians.quality import mismatching_pixels, mismatching_pixels_8bit, psnr_db
from gaussians.render import StereoFrame, render_stereo
from gaussians.stereo_method import PRESETS
from nebula.images import difference_png, png
from nebula.measure import covered_shares, own_right
from nebula.options import RenderOptions
from nebula.output import CommandResult, OutputDirectory
from nebula.progress import progress
from nebula.scene_input import SceneInput, describe_files, load, require_visible


def run(options: RenderOptions) -> CommandResult:
    """Write left.png, right.png, difference.png and render.json into the output directory."""
    with OutputDirectory(options.out) as out:
        place = load(options.scene, options.seed)
        near_m = place.placement.near_m
        rig = StereoRig(options.scene.display, place.view, options.baseline_m, near_m)
        with progress("rendering both eyes"):
            frame = render_stereo(place.scene, rig, PRESETS[options.method], compare=True)
        require_visible(sum(frame.visible), "render")
        data = _describe(place, frame)
        out.write_bytes("left.png", png(frame.left))
        out.write_bytes("right.png", png(frame.right))
        out.write_bytes("difference.png", difference_png(frame.right, own_right(frame)))
        out.write_json("render.json", data)
    text = (
        f"{place.name}: {data['visible_splats']['left']} splats in the left eye, "
        f"{data['covered_pixels_share']['left']:.1%} of its pixels covered\n"
        f"{data['method']}\n"
        f"right eye: {data['right_mismatching_pixels']} of {data['pixels']} pixels differ "
        f"from an independent right eye ({data['right_mismatching_pixels_8bit']} in 8 bit)\n"
        f"{options.out / 'left.png'}\n{options.out / 'right.png'}"
    )
    return CommandResult(data, text)


def _describe(place: SceneInput, frame: StereoFrame) -> dict[str, Any]:
    own = own_right(frame)
    front = frame.work.front_end
    return {
        "scene": place.name,
        "splats": len(place.scene),
        "sh_degree": place.scene.sh_degree,
        "inputs": describe_files(place.files),
        "method": frame.work.method,
        "visible_splats": dict(zip(("left", "right"), frame.visible, strict=True)),
        "covered_pixels_share": dict(zip(("left", "right"), covered_shares(frame), strict=True)),
        "right_mismatching_pixels": mismatching_pixels(frame.right, own),
        "right_mismatching_pixels_8bit": mismatching_pixels_8bit(frame.right, own),
        "psnr_db": psnr_db(frame.right, own),
        "pixels": frame.work.width * frame.work.height,
        "culled": {
            "behind_near": front.behind_near,
            "transparent": front.transparent,
            "degenerate": front.degenerate,
        },
        "ill_conditioned": front.ill_conditioned,
        "list_entries": {"left": front.left_pairs, "right": front.right_pairs},
    }
