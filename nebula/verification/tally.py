"""What is reported of one stereo method: its errors, their causes, and the work it took."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.attribution import CauseCount
from gaussians.errors import InputError
from gaussians.quality import (
    MissingQualityExtra,
    flip,
    max_abs,
    mean_abs,
    mismatching_pixels,
    mismatching_pixels_8bit,
    psnr_db,
    ssim,
)
from gaussians.rasterization import EyeImage
from gaussians.render import StereoFrame
from gaussians.stereo_method import StereoMethod

Float32 = NDArray[np.float32]


class MethodTally:
    """Sums up one method over the frames of one scene; ``row`` is its entry in the report.

    Counts are sums over the frames, PSNR is that of the mean squared error, ``ssim``, ``flip`` and
    ``mean_abs`` are means over the frames, None where a measure could not be taken.
    """

    def __init__(self, method: StereoMethod, pixels_per_degree: float) -> None:
        self.method = method
        self._ppd = pixels_per_degree
        self._frames: list[dict[str, Any]] = []
        self._causes: dict[str, list[CauseCount]] = {}
        self.missing: set[str] = set()  # why a measure could not be taken

    def add(
        self, frame: StereoFrame, reference: EyeImage, causes: Mapping[str, CauseCount]
    ) -> None:
        """One frame by the method, judged by the independent right eye."""
        self._frames.append(self._errors(frame.right, reference.image) | _work(frame))
        self._frames[-1]["covered"] = float((reference.transmittance < 1).mean())
        for name, count in causes.items():
            self._causes.setdefault(name, []).append(count)

    def _errors(self, right: Float32, reference: Float32) -> dict[str, Any]:
        psnr = psnr_db(right, reference)
        return {
            "mismatching_pixels": mismatching_pixels(right, reference),
            "mismatching_pixels_8bit": mismatching_pixels_8bit(right, reference),
            "squared_error": 0.0 if psnr is None else 10.0 ** (-psnr / 10.0),
            "max_abs": max_abs(right, reference),
            "mean_abs": mean_abs(right, reference),
            "ssim": self._taken(lambda: ssim(right, reference)),
            "flip": self._taken(lambda: flip(right, reference, pixels_per_degree=self._ppd)),
        }

    def _taken(self, measure: Callable[[], float]) -> float | None:
        try:
            return measure()
        except (MissingQualityExtra, InputError) as error:  # not installed, or too small an image
            self.missing.add(str(error))
            return None

    def row(self) -> dict[str, Any]:
        """The keys of ``rows[]`` in verify.json; docs/stereo.md explains them."""
        frames = self._frames
        total = {key: sum(f[key] for f in frames) for key in _COUNTS}
        error = _mean([f["squared_error"] for f in frames])
        entries = total["left_entries"]
        return {
            "method": self.method.name,
            "description": str(self.method),
            "mismatching_pixels": total["mismatching_pixels"],
            "mismatching_pixels_8bit": total["mismatching_pixels_8bit"],
            "pixels": total["pixels"],
            "psnr_db": -10.0 * math.log10(error) if error else None,
            "max_abs": max(f["max_abs"] for f in frames),
            "mean_abs": _mean([f["mean_abs"] for f in frames]),
            "ssim": _mean([f["ssim"] for f in frames]),
            "flip": _mean([f["flip"] for f in frames]),
            "rows": self.method.rows,
            **{key: total[key] for key in _WORK},
            "row_writes_per_entry": total["inserted"] / entries if entries else 0.0,
            "causes": {name: _summed(counts) for name, counts in self._causes.items()},
            "covered_pixels_share": _mean([f["covered"] for f in frames]),
        }


_WORK = (
    *("inserted", "forward_only", "entries_after_termination"),
    *("dropped", "spilled", "unseen", "duplicates", "independent_tiles"),
    *("left_entries", "right_entries", "processed_left", "processed_right", "alpha_checks"),
)
_COUNTS = ("mismatching_pixels", "mismatching_pixels_8bit", "pixels", *_WORK)


def _work(frame: StereoFrame) -> dict[str, int]:
    work, stereo = frame.work, frame.work.stereo
    return {
        "pixels": work.width * work.height,
        "inserted": int(stereo.fifo_entries.sum()),
        "forward_only": int(stereo.forward_only.sum()),
        "entries_after_termination": int(stereo.walked_after_termination.sum()),
        "dropped": stereo.dropped,
        "spilled": stereo.spilled,
        "unseen": stereo.unseen,
        "duplicates": stereo.duplicates,
        "independent_tiles": work.independent_right_tiles,
        "left_entries": int(work.left.entries.sum()),
        "right_entries": int(work.right.entries.sum()),
        "processed_left": int(work.left.processed.sum()),
        "processed_right": int(work.right.processed.sum()),
        "alpha_checks": int(work.left.alpha_checks.sum()) + int(work.right.alpha_checks.sum()),
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _summed(counts: Sequence[CauseCount]) -> dict[str, int]:
    return {
        name: sum(getattr(count, name) for count in counts)
        for name in CauseCount.__dataclass_fields__
    }
