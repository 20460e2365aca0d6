"""Number formats of the rendering datapath, as data: `fp32`, half-precision variants, and `hw`.

`fp32` is the reference, `rasterise` itself. A `HalfFormat` is float32 with some parts rounded to
half precision. A `FixedFormat` is the integer datapath of the hardware: docs/number_formats.md is
its contract, fixed_records.py and fixed_point.py are its one definition. Only `fp32` promises an
image that does not depend on the tile size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians import fixed_point, fixed_records, half_precision
from gaussians.constants import FEATURES
from gaussians.errors import InputError
from gaussians.fixed_records import FixedFormat
from gaussians.half_precision import HalfFormat
from gaussians.rasterization import rasterise
from gaussians.tiling import TileGrid, TileLists

Float32 = NDArray[np.float32]
NumberFormat = HalfFormat | FixedFormat

FORMATS: dict[str, NumberFormat] = {
    made.name: made
    for made in (
        HalfFormat("fp32"),
        HalfFormat("fp16_accumulators", accumulators=True),
        HalfFormat("fp16_alpha", alpha=True),
        HalfFormat("fp16_blending", alpha=True, accumulators=True),
        HalfFormat("fp16_features", features=True),
        HalfFormat("fp16", features=True, power=True, alpha=True, accumulators=True),
        FixedFormat("hw"),
    )
}


@dataclass(frozen=True)
class Saturations:
    """What did not fit the format and was held at its limit (infinity in half precision).

    Splats are counted once each and only where they stand in a list; accumulators are counted per
    pixel and channel.
    """

    centres: int
    conics: int
    opacities: int
    colours: int
    accumulators: int

    @property
    def total(self) -> int:
        """Sum over all of them; 0 means that everything fitted."""
        return self.centres + self.conics + self.opacities + self.colours + self.accumulators


@dataclass(frozen=True)
class FormatImage:
    """One eye rendered in a number format."""

    image: Float32  # [H, W, 3]
    saturations: Saturations


def rasterise_in_format(
    number_format: NumberFormat,
    features: Float32,
    lists: TileLists,
    grid: TileGrid,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> FormatImage:
    """Render one eye in a number format.

    Parameters
    ----------
    features : [M, 10] float32 feature records by rank, as for ``rasterise``
    lists : tile lists of the same grid
    background : colour behind everything

    Raises InputError for NaN among the features of listed splats, and where window or background
    are beyond what a fixed-point format can hold.
    """
    f = number_format
    if f == HalfFormat(f.name):
        image = rasterise(features, lists, grid, background).image
        return FormatImage(image, Saturations(0, 0, 0, 0, 0))
    listed = np.zeros((len(features), 1), np.bool_)
    listed[lists.splats] = True
    features = np.where(listed, features[:, :FEATURES], np.float32(0))
    if np.isnan(features).any():
        raise InputError("features of listed splats must be numbers, not NaN")
    if isinstance(f, FixedFormat):
        integers, over = fixed_records.encode(features, f)
        image, held = fixed_point.rasterise_fixed(f, integers, lists, grid, background)
    else:
        stored, over = half_precision.encode(features, f)
        image = half_precision.rasterise_half(f, stored, lists, grid, background)
        held = int(np.isinf(image).sum())
    return FormatImage(image, Saturations(*over, held))
