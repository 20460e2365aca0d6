"""``nebula convert``: one scene file to another, whole or in part. All lengths in file units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussians.errors import InputError
from gaussians.formats import fit_scene, load_scene, save_scene
from gaussians.formats.files import losses
from gaussians.placement import auto_view, parse_view
from gaussians.rotations import up_vector
from gaussians.scene import Scene
from gaussians.transforms import Box, crop, parse_box, transformed, up_rotation, with_sh_degree
from lod_cloud import SearchRequest, build_tree, flat_search
from nebula.options import ConvertOptions
from nebula.output import CommandResult, OutputDirectory
from nebula.progress import progress
from nebula.scene_input import describe_files

SUFFIXES = (".ply", ".splat", ".spz")
_DEFAULT_UP = "-y"  # of files


@dataclass(frozen=True)
class _Decimation:
    """What a cut kept."""

    tau_px: float
    focal_px: float
    eye: tuple[float, float, float]  # file units
    leaves: int  # Gaussians of the input
    merged: int  # nodes that stand for several of them


def run(options: ConvertOptions) -> CommandResult:
    """Read, crop, drop harmonics, decimate, turn, fit to the format, write; in this order.

    The output appears complete or not at all, and replaces a file of its name. It must not be one
    of the files read: what a conversion drops could not be had back. Raises InputError for that,
    for an unknown suffix, an empty crop, harmonics that the scene or the format does not have, and
    for values beyond what the format can hold (merged opacities above 1, say) unless ``clamp`` is
    set; they are counted.
    """
    source, out = options.scene.scene, options.out
    up = options.scene.up or _DEFAULT_UP
    assert isinstance(source, Path)  # by the command line
    box = None if options.crop is None else parse_box(options.crop)
    _check_target(out, options.sh_degree)
    with OutputDirectory(out.parent) as directory:
        with progress(f"reading {source}"):
            read, files = load_scene(source, options.scene.level)
        _check_not_read(out, files)
        scene = read if box is None else _cropped(read, box, source)
        in_box = len(scene)
        if options.sh_degree is not None:
            scene = with_sh_degree(scene, options.sh_degree)
        _check_harmonics(scene, out)
        decimation = None
        if options.decimate_tau_px is not None:
            scene, decimation = _decimated(scene, options, options.decimate_tau_px, up)
        turn = None
        if options.new_up is not None:
            turn = up_rotation(up, options.new_up)
            scene = transformed(scene, turn)
        scene, clamped = _fitted(scene, out, options.clamp)
        with progress(f"writing {out}"):
            save_scene(scene, directory.file(out.name))
        size = directory.file(out.name).stat().st_size
    data: dict[str, Any] = {
        "scene": source.name,
        "out": str(out),
        "format": out.suffix.lower()[1:],
        "bytes": size,
        "gaussians": {"read": len(read), "outside_crop": len(read) - in_box, "written": len(scene)},
        "crop": None if box is None else {"low": box.low, "high": box.high},
        "sh_degree": {"read": read.sh_degree, "written": scene.sh_degree},
        "decimation": None if decimation is None else vars(decimation),
        "clamped": clamped,
        "turn": None if turn is None else {"from": up, "to": options.new_up, "rotation": turn},
        "inputs": describe_files(files),
    }
    return CommandResult(data, _text(data))


def _check_target(out: Path, sh_degree: int | None) -> None:
    """What can be known of the output before the input is read."""
    suffix = out.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{out}: must end in one of {', '.join(SUFFIXES)}")
    if out.is_dir():
        raise InputError(f"{out}: must be a file, but a directory stands there")
    if suffix == ".splat" and sh_degree:
        raise InputError(f"{out}: .splat holds no spherical harmonics; give --sh-degree 0")


def _check_not_read(out: Path, files: Iterable[Path]) -> None:
    if out.exists() and any(file.exists() and out.samefile(file) for file in files):
        raise InputError(f"{out}: must not be a file of the scene that is read; name another one")


def _check_harmonics(scene: Scene, out: Path) -> None:
    if out.suffix.lower() == ".splat" and scene.sh_degree:
        raise InputError(
            f"{out}: .splat holds no spherical harmonics above degree 0, the scene has degree "
            f"{scene.sh_degree}; give --sh-degree 0 to drop them"
        )


def _cropped(scene: Scene, box: Box, source: Path) -> Scene:
    kept = crop(scene, box)
    if not len(kept):
        low, high = (", ".join(f"{v:g}" for v in f(scene.means, axis=0)) for f in (np.min, np.max))
        raise InputError(
            f"{source}: no Gaussian lies in the crop box; means go from ({low}) to ({high})"
        )
    return kept


def _decimated(
    scene: Scene, options: ConvertOptions, tau_px: float, up: str
) -> tuple[Scene, _Decimation]:
    """The cut of the scene's tree for an eye at the given view, or at one that frames it all."""
    view = options.scene.view
    eye, _ = auto_view(scene, up) if view is None else parse_view(view)
    display = options.scene.display
    request = SearchRequest(eye, max(display.fx, display.fy), tau_px)
    x, y, z = (float(c) for c in up_vector(up))
    with progress("building the tree"):
        tree = build_tree(scene, up=(x, y, z))
    ids = flat_search(tree, request).node_ids
    merged = int(np.count_nonzero(tree.child_count[ids]))
    kept = tree.gaussians.take(ids)
    return kept, _Decimation(tau_px, request.focal_px, eye, len(scene), merged)


def _fitted(scene: Scene, out: Path, clamp: bool) -> tuple[Scene, dict[str, int]]:
    """The scene within the limits of the format, and how many values were outside, by kind."""
    fitted, beyond = fit_scene(scene, out)
    if beyond and not clamp:
        hint = ""
        if (scene.opacities > 1).any():
            hint = f" (merged Gaussians may have them, up to {scene.opacities.max():.3g} here)"
        raise InputError(
            f"{out}: {out.suffix} cannot hold {losses(beyond)}{hint}; give --clamp to store the "
            "nearest values it can"
        )
    return fitted, beyond


def _text(data: dict[str, Any]) -> str:
    counts, degree, cut = data["gaussians"], data["sh_degree"], data["decimation"]
    lines = [f"{data['scene']}: {counts['read']} Gaussians, harmonics of degree {degree['read']}"]
    if data["crop"] is not None:
        lines.append(f"crop: {counts['outside_crop']} outside, left out")
    if degree["read"] != degree["written"]:
        lines.append(f"harmonics: degree {degree['read']} cut to {degree['written']}")
    if cut is not None:
        eye = ", ".join(f"{c:.3g}" for c in cut["eye"])
        lines.append(
            f"decimation at {cut['tau_px']:g} px seen from ({eye}) with f = {cut['focal_px']:.0f} "
            f"px: {cut['leaves']} to {counts['written']}, {cut['merged']} of them merged"
        )
    if data["turn"] is not None:
        lines.append(f"turned: up was {data['turn']['from']}, is {data['turn']['to']}")
    if data["clamped"]:
        lines.append(f"clamped: {losses(data['clamped'])}")
    lines.append(f"{data['out']}: {counts['written']} Gaussians, {data['bytes']} bytes")
    return "\n".join(lines)
