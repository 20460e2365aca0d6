"""``nebula info``: what is in a scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from nebula.options import InfoOptions
from nebula.output import CommandResult
from nebula.scene_input import describe_files, load

_PERCENTILES = (0, 1, 50, 99, 100)


def run(options: InfoOptions) -> CommandResult:
    """Counts, harmonics, bounds, opacities and scales of a scene, in metres."""
    place = load(options.scene, options.seed)
    scene = place.scene
    largest = scene.scales.max(axis=1)
    bounds = np.percentile(scene.means.astype(np.float64), _PERCENTILES, axis=0)
    forward = place.view.rotation[:, 2]
    data: dict[str, Any] = {
        "scene": place.name,
        "splats": len(scene),
        "sh_degree": scene.sh_degree,
        "up": place.placement.up,
        "percentiles": list(_PERCENTILES),
        "position_m": bounds.tolist(),
        "opacity": np.percentile(scene.opacities.astype(np.float64), _PERCENTILES).tolist(),
        "largest_scale_m": np.percentile(largest.astype(np.float64), _PERCENTILES).tolist(),
        "view": {"eye_m": place.view.position.tolist(), "forward": forward.tolist()},
        "inputs": describe_files(place.files),
    }
    rows = [("x, m", bounds[:, 0]), ("y, m", bounds[:, 1]), ("z, m", bounds[:, 2])]
    rows += [("opacity", data["opacity"]), ("largest scale, m", data["largest_scale_m"])]
    lines = [
        f"{place.name}: {len(scene)} Gaussians, spherical harmonics of degree {scene.sh_degree}, "
        f"up {place.placement.up}",
        f"{'':18}" + "".join(f"{f'{p} %':>11}" for p in _PERCENTILES),
    ]
    lines += [f"{name:18}" + "".join(f"{v:11.4g}" for v in values) for name, values in rows]
    eye, look = (", ".join(f"{c:.3g}" for c in v) for v in (place.view.position, forward))
    lines.append(f"first view: from ({eye}) m towards ({look})")
    return CommandResult(data, "\n".join(lines))
