"""Standard deviations and node spheres in few bits: logarithms of what follows from another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.compression import LogField, UInt16
from lod_cloud.codec.training import within
from lod_cloud.lod_tree import Float32

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

BYTE = 255
ROTATION = 63
WIDE = 351  # for ranges that take in the coarsest nodes: codes that are rare cost the others little
SPHERE = 15
_THINNEST = -12.0  # logarithm of a ratio that is told from 0
_RATIO = LogField(_THINNEST, 0.0, top=BYTE)
_SLACK = 1.05  # decoded scales differ from those that ratios were trained on


@dataclass(frozen=True)
class ShapeFields:
    """The largest standard deviation, the ratios of the others to it, and of R and e to what
    follows from all three.
    """

    largest: LogField
    radius: LogField
    extent: LogField

    @classmethod
    def train(cls, scales: Float32, inner: Mask, radius: Float32, extent: Float32) -> ShapeFields:
        """Ranges from nodes [N], of which ``inner`` have a sphere."""
        sigmas = scales[inner].astype(np.float64)
        return cls(
            LogField.covering(within(scales.max(axis=1)), top=WIDE),
            _ratios(radius[inner], _half_diagonal(sigmas)),
            _ratios(extent[inner], _longest_side(sigmas)),
        )

    @classmethod
    def of(cls, ranges: list[list[float]]) -> ShapeFields:
        """Inverse of `ranges`."""
        (a, b), radius, extent = ranges
        wrapped = [LogField(low, high, True, SPHERE) for low, high in (radius, extent)]
        return cls(LogField(a, b, top=WIDE), *wrapped)

    @property
    def ranges(self) -> list[list[float]]:
        """Ends of the three ranges."""
        return [[field.low, field.high] for field in (self.largest, self.radius, self.extent)]

    def encode(self, scales: Float64) -> tuple[UInt16, Mask]:
        """[N, 3] codes of standard deviations in falling order, and which are in the range.

        Ratios below 2^-12 become 0.
        """
        largest, valid = self.largest.encode(scales[:, 0])
        thin = scales[:, 1:] / np.where(scales[:, :1] > 0, scales[:, :1], 1)
        ratios, _ = _RATIO.encode(np.where(thin < 2.0**_THINNEST, 0, thin))
        return np.hstack([largest[:, None], ratios]), valid & (largest > 0)

    def decode(self, codes: UInt16) -> Float64:
        """[N, 3] standard deviations; each a float32."""
        largest = self.largest.decode(codes[:, :1]).astype(np.float64)
        sigmas = np.hstack([largest, largest * _RATIO.decode(codes[:, 1:])])
        return sigmas.astype(np.float32).astype(np.float64)

    def encode_spheres(
        self, sigmas: Float64, radius: Float32, extent: Float32
    ) -> tuple[UInt16, Mask]:
        """[N, 2] codes of R and e for decoded standard deviations, and which are in the range."""
        one, fits = self.radius.encode(radius / np.maximum(_half_diagonal(sigmas), 1e-300))
        other, too = self.extent.encode(extent / np.maximum(_longest_side(sigmas), 1e-300))
        return np.stack([one, other], axis=1), fits & too

    def decode_spheres(self, codes: UInt16, sigmas: Float64) -> Float32:
        """[N, 2] R and e, never below what was coded."""
        radius = self.radius.decode(codes[:, 0]) * _half_diagonal(sigmas)
        extent = self.extent.decode(codes[:, 1]) * _longest_side(sigmas)
        return _rounded_up(np.stack([radius, extent], axis=1))


def surface(sigmas: Float64) -> Float64:
    """[N] s0 s1 + s0 s2 + s1 s2."""
    a, b, c = sigmas.T
    return np.asarray(a * b + a * c + b * c)


def _ratios(values: Float32, bases: Float64) -> LogField:
    some = bases > 0
    ratios = within(values[some] / bases[some])
    if not len(ratios):
        return LogField(-1.0, 1.0, True, SPHERE)
    ends = np.array([ratios.min() / _SLACK, ratios.max() * _SLACK])
    return LogField.covering(ends, round_up=True, top=SPHERE)


def _half_diagonal(sigmas: Float64) -> Float64:
    return 3.0 * np.sqrt((sigmas * sigmas).sum(axis=1))


def _longest_side(sigmas: Float64) -> Float64:
    return 6.0 * sigmas.max(axis=1, initial=0.0)


def _rounded_up(values: Float64) -> Float32:
    nearest = values.astype(np.float32)
    return np.where(nearest < values, np.nextafter(nearest, np.float32(np.inf)), nearest)
