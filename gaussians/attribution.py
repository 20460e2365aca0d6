"""Why a pixel of the right eye is wrong: counterfactuals of the method's causes.

Cause i is *sufficient* in a pixel if the method with only that cause is wrong there, *necessary* if
the method with all its causes but that one is right there. A pixel's label is the one necessary
cause; where there is none or several, the sufficient cause with the largest 8-bit error; where none
is sufficient either, causes interact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.quality import differing, error_8bit
from gaussians.render import StereoRenderer
from gaussians.stereo_causes import CAUSE_NAMES, causes_of, keeping
from gaussians.stereo_method import StereoMethod

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Labels = NDArray[np.uint8]

LABELS = (*CAUSE_NAMES, "interaction", "unknown")  # label i stands for LABELS[i - 1]; 0: right
INTERACTION, UNKNOWN = len(LABELS) - 1, len(LABELS)


@dataclass(frozen=True)
class CauseCount:
    """Pixels of one cause."""

    pixels: int  # labelled so, of those with other float32 bits
    pixels_8bit: int  # labelled so, of those that differ in 8 bit
    necessary: int
    sufficient: int
    runner_up: int  # sufficient with the second largest 8-bit error, behind the label


@dataclass(frozen=True)
class CauseMap:
    """Labels of one right image."""

    labels: Labels  # [H, W]
    counts: dict[str, CauseCount]  # of LABELS, those present


class Attribution:
    """Labels the wrong pixels of any method of one renderer; keeps the counterfactuals' maps."""

    def __init__(self, renderer: StereoRenderer) -> None:
        self._renderer = renderer
        self._wrong: dict[StereoMethod, Mask] = {}
        self._errors: dict[StereoMethod, Labels] = {}

    def attribute(self, method: StereoMethod, right: Float32) -> CauseMap:
        """Causes of the wrong pixels of ``right`` [H, W, 3], the right eye by ``method``."""
        reference = self._renderer.independent_right().image
        wrong, visibly = differing(right, reference), error_8bit(right, reference) > 0
        causes = causes_of(method)
        shape = wrong.shape
        necessary, the_one = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        largest, second = np.full(shape, -1, np.int16), np.full(shape, -1, np.int16)
        first_label, second_label = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        tally: dict[str, tuple[int, int]] = {}
        for cause in causes if wrong.any() else ():
            label = CAUSE_NAMES.index(cause) + 1
            others = tuple(other for other in causes if other != cause)
            needed = wrong & ~self._is_wrong(keeping(method, others, ""))
            necessary += needed
            the_one[needed] = label
            alone = keeping(method, (cause,), "")
            enough = wrong & self._is_wrong(alone)
            error = np.where(enough, self._errors[alone].astype(np.int16), -1)
            ahead = error > largest
            behind = ~ahead & (error > second)
            second_label = np.where(ahead, first_label, np.where(behind, label, second_label))
            second = np.where(ahead, largest, np.where(behind, error, second))
            first_label, largest = np.where(ahead, label, first_label), np.maximum(error, largest)
            tally[cause] = int(needed.sum()), int(enough.sum())
        labels = np.where(first_label > 0, first_label, INTERACTION if causes else UNKNOWN)
        labels = np.where(necessary == 1, the_one, labels)
        labels = np.where(wrong, labels, 0).astype(np.uint8)
        runner_up = np.where(labels == first_label, second_label, first_label)
        counts = {
            name: CauseCount(
                int((labels == i).sum()),
                int(((labels == i) & visibly).sum()),
                *tally.get(name, (0, 0)),
                int((wrong & (runner_up == i)).sum()),
            )
            for i, name in enumerate(LABELS, 1)
            if name in causes or (labels == i).any()
        }
        return CauseMap(labels, counts)

    def _is_wrong(self, method: StereoMethod) -> Mask:
        """[H, W] where the right eye by ``method`` has other bits than the independent one."""
        if method not in self._wrong:
            right = self._renderer.render(method).right
            reference = self._renderer.independent_right().image
            self._wrong[method] = differing(right, reference)
            self._errors[method] = error_8bit(right, reference)
        return self._wrong[method]
