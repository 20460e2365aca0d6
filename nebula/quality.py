"""Image quality of the stream: decoded against the uncoded cut, and both against all leaves."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.parallel import threads
from gaussians.quality import MissingQualityExtra, psnr_db, ssim
from gaussians.render import render_mono
from gaussians.scene import Scene
from lod_cloud import LodTree

Float32 = NDArray[np.float32]

PAIRS = ("decoded_vs_cut", "cut_vs_leaves", "decoded_vs_leaves")


class QualityComparison:
    """Compares the left eye of the first and the last frame; keeps numbers, not images."""

    def __init__(self, tree: LodTree, leaves: Scene, frames: int) -> None:
        self._tree = tree
        self._leaves = leaves
        self._frames = sorted({0, frames - 1})
        self._errors: dict[str, list[float]] = {pair: [] for pair in PAIRS}
        self._ssims: dict[str, list[float]] = {pair: [] for pair in PAIRS}
        self._missing: list[str] = []

    def compare(
        self, index: int, node_ids: NDArray[np.int32], decoded: Float32, rig: StereoRig
    ) -> None:
        """Render the same cut uncoded and all leaves from the left eye, where the frame is asked
        for.
        """
        if index not in self._frames:
            return
        cut, _ = render_mono(self._tree.gaussians.take(node_ids), rig)
        leaves, _ = render_mono(self._leaves, rig)
        images = ((decoded, cut), (cut, leaves), (decoded, leaves))
        for pair, (a, b) in zip(PAIRS, images, strict=True):
            psnr = psnr_db(a, b)
            self._errors[pair].append(0.0 if psnr is None else 10.0 ** (-psnr / 10.0))
        try:
            with ThreadPoolExecutor(threads()) as pool:  # the filters release the GIL
                values = list(pool.map(lambda pair: ssim(*pair), images))
        except MissingQualityExtra as error:
            self._missing = [f"SSIM was not computed: {error}"]
            return
        for pair, value in zip(PAIRS, values, strict=True):
            self._ssims[pair].append(value)

    def result(self) -> tuple[dict[str, Any], list[str]]:
        """The report's group, means over the compared frames, and what could not be computed."""
        group: dict[str, Any] = {"frames": self._frames}
        for pair in PAIRS:
            error, ssims = float(np.mean(self._errors[pair])), self._ssims[pair]
            group[pair] = {
                "psnr_db": -10.0 * float(np.log10(error)) if error > 0 else None,
                "ssim": float(np.mean(ssims)) if ssims else None,
            }
        return group, self._missing
