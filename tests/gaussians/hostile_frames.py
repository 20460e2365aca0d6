"""The hostile cases built, rendered and binned, each once per test run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import U
from gaussians.projection import ProjectedSplats, project
from gaussians.render import StereoFrame, render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.synthetic import HOSTILE, HostileCase
from gaussians.tiling import RowSpans, TileGrid, TileLists, row_spans

NAMES = list(HOSTILE)
TILES = (4, 8)


@cache
def built(name: str) -> HostileCase:
    return HOSTILE[name]()


@cache
def rendered(name: str, method: str, tile_px: int) -> StereoFrame:
    """One frame; but for `independent`, with the right eye on its own beside it."""
    case, compare = built(name), method != "independent"
    return render_stereo(
        case.scene, case.rig, PRESETS[method], case.background, tile_px, compare=compare
    )


def same_bits(one: NDArray[np.float32], other: NDArray[np.float32] | None) -> bool:
    """Whether two float32 images are equal bit for bit."""
    assert other is not None and one.dtype == other.dtype == np.float32
    return np.array_equal(one.view(np.uint32), other.view(np.uint32))


def same_lists(one: TileLists, other: TileLists) -> bool:
    return np.array_equal(one.offsets, other.offsets) and np.array_equal(one.splats, other.splats)


@dataclass(frozen=True)
class Look:
    """A case after projection and binning."""

    case: HostileCase
    splats: ProjectedSplats
    rows: RowSpans

    @property
    def centres(self) -> NDArray[np.float32]:
        """[2, M] column of the centre in each eye's window."""
        return self.splats.features[:, :, U]

    @property
    def disparity(self) -> NDArray[np.float64]:
        """[M] pixels."""
        product = self.case.rig.baseline_m * self.case.rig.display.fx
        return product / self.splats.depths.astype(np.float64)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[2, M] whether the splat stands in a tile of the eye."""
        seen = np.zeros((2, len(self.splats.ids)), bool)
        for eye, spans in enumerate(self.rows.spans):
            seen[eye, self.rows.ranks[spans[:, 0] <= spans[:, 1]]] = True
        return seen

    @property
    def only_right(self) -> NDArray[np.bool_]:
        """[M] seen by the right eye alone."""
        return self.seen[1] & ~self.seen[0]


def looked_at(name: str, tile_px: int = 4) -> Look:
    case = built(name)
    splats = project(case.scene, case.rig)
    display = case.rig.display
    return Look(case, splats, row_spans(splats, TileGrid(display.width, display.height, tile_px)))


def alone(look: Look, eye: int) -> RowSpans:
    """One eye, 0 or 1, binned without any knowledge of the other."""
    features, covariances = look.splats.features, look.splats.covariances
    one = replace(
        look.splats,
        features=features[eye : eye + 1].copy(),
        covariances=covariances[eye : eye + 1].copy(),
    )
    return row_spans(one, look.rows.grid)


def pairs(lists: TileLists) -> set[tuple[int, int]]:
    """All (tile, splat)."""
    tiles = np.repeat(np.arange(len(lists.offsets) - 1), np.diff(lists.offsets))
    return set(zip(tiles.tolist(), lists.splats.tolist(), strict=True))
