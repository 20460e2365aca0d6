"""The fields of a node but its harmonics above degree 0, as small whole numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.compression import LinearField, LogField, UInt16, decode_rotation, encode_rotation
from gaussians.errors import InputError
from gaussians.scene import Scene
from lod_cloud.codec.axes import sorted_axes
from lod_cloud.codec.node_columns import Column
from lod_cloud.codec.positions import PositionSteps
from lod_cloud.codec.shapes import ROTATION, WIDE, ShapeFields, surface
from lod_cloud.codec.tolerance import CODED_MASS_ERROR
from lod_cloud.codec.training import Sample, within
from lod_cloud.lod_tree import Float32
from lod_cloud.node_records import NodeRecords

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_OPACITY_LOW = np.float32(2.0**-12)
_COLOUR_MARGIN = 0.125  # of the sampled range at either end: fewer escapes for 2 dB of 61
_MOST_COLOUR_BITS = 10


@dataclass(frozen=True)
class NodeCodes:
    """What may be sent of some nodes."""

    places: Int64  # [N, 3]
    shape: UInt16  # [N, 3]
    omitted: NDArray[np.uint8]  # [N]
    rotation: UInt16  # [N, 3]
    opacity: UInt16  # [N]
    dc: UInt16  # [N, 3]
    spheres: UInt16  # [N, 2]
    sigmas: Float64  # [N, 3] as they will be decoded

    def columns(self, kept: Mask, inner: Mask, colours: int) -> dict[str, Column]:
        """By the keys of `lod_cloud.codec.node_columns`; of the nodes ``kept``."""
        red, green, blue = self.dc[kept].T.astype(np.int64)
        spheres = self.spheres[kept & inner]
        return {
            **{f"scale.{axis}": self.shape[kept, axis] for axis in range(3)},
            "rotation.axis": self.omitted[kept],
            **{f"rotation.{axis}": self.rotation[kept, axis] for axis in range(3)},
            "opacity": self.opacity[kept],
            "colour.green": green,
            "colour.red": (red - green) % colours,
            "colour.blue": (blue - green) % colours,
            "spheres.radius": spheres[:, 0],
            "spheres.extent": spheres[:, 1],
        }


@dataclass(frozen=True)
class NodeFields:
    """How each field is coded."""

    position: PositionSteps
    shape: ShapeFields
    opacity: LogField
    dc: LinearField

    def __post_init__(self) -> None:
        if not 1 <= self.dc.top < 1 << _MOST_COLOUR_BITS:
            raise InputError(f"colour bits must be 1 to {_MOST_COLOUR_BITS}")

    @classmethod
    def train(cls, sample: Sample, position_bits: int, colour_bits: int) -> NodeFields:
        """Ranges from nodes of a tree."""
        dc = within(sample.dc)
        low, high = float(dc.min()), float(dc.max())
        margin = _COLOUR_MARGIN * (high - low) if high > low else 1.0
        opacities = np.maximum(within(sample.opacities), _OPACITY_LOW)
        return cls(
            position=PositionSteps(position_bits),
            shape=ShapeFields.train(sample.scales, sample.inner, sample.radius, sample.extent),
            opacity=LogField.covering(opacities, top=WIDE),
            dc=LinearField(low - margin, high + margin, (1 << colour_bits) - 1),
        )

    @property
    def parameters(self) -> dict[str, Any]:
        """That JSON knows."""
        return {
            "position_bits": self.position.bits,
            "shape": self.shape.ranges,
            "opacity": [self.opacity.low, self.opacity.high],
            "dc": [self.dc.low, self.dc.high, self.dc.top],
        }

    @classmethod
    def of(cls, p: Mapping[str, Any]) -> NodeFields:
        """Inverse of `parameters`."""
        return cls(
            position=PositionSteps(int(p["position_bits"])),
            shape=ShapeFields.of(p["shape"]),
            opacity=LogField(p["opacity"][0], p["opacity"][1], top=WIDE),
            dc=LinearField(*p["dc"]),
        )

    def encode(self, nodes: NodeRecords) -> tuple[NodeCodes, Mask]:
        """Codes of every node, and which nodes they do not stand for well enough."""
        scene = nodes.gaussians
        scales, quaternions = sorted_axes(scene.scales, scene.quaternions)
        shape, in_range = self.shape.encode(scales)
        sigmas = self.shape.decode(shape)
        places, placed = self.position.encode(scene.means, sigmas[:, 0])
        opacity, fits = self.opacity.encode(scene.opacities)
        dc, dc_fits = self.dc.encode(scene.sh[:, 0])
        spheres, wrapped = self.shape.encode_spheres(sigmas, nodes.radius, nodes.extent)
        omitted, rotation = encode_rotation(quaternions.astype(np.float32), ROTATION)
        off = np.abs(self.position.decode(places, sigmas[:, 0]).astype(np.float64) - scene.means)
        mass = scene.opacities * surface(scales)
        lost = np.abs(self.opacity.decode(opacity) * surface(sigmas) - mass)
        valid = in_range & placed & fits & dc_fits.all(axis=1)
        valid &= wrapped | (nodes.child_counts == 0)
        valid &= (off <= self.position.max_error * scales[:, :1]).all(axis=1)
        valid &= lost <= CODED_MASS_ERROR * mass
        return NodeCodes(places, shape, omitted, rotation, opacity, dc, spheres, sigmas), ~valid

    def sigmas(self, values: Mapping[str, Column]) -> Float64:
        """[N, 3] standard deviations."""
        return self.shape.decode(_stacked(values, "scale.0", "scale.1", "scale.2"))

    def decode(self, values: Mapping[str, Column], sigmas: Float64, places: Int64) -> Scene:
        """Gaussians of SH degree 0 from their columns."""
        green, colours = values["colour.green"], self.dc.top + 1
        red, blue = ((values[key] + green) % colours for key in ("colour.red", "colour.blue"))
        return Scene(
            self.position.decode(places, sigmas[:, 0]),
            decode_rotation(
                values["rotation.axis"].astype(np.uint8),
                _stacked(values, "rotation.0", "rotation.1", "rotation.2"),
                ROTATION,
            ),
            sigmas.astype(np.float32),
            self.opacity.decode(values["opacity"].astype(np.uint16)),
            self.dc.decode(np.stack([red, green, blue], axis=1).astype(np.uint16))[:, None],
        )

    def spheres(self, values: Mapping[str, Column], sigmas: Float64) -> Float32:
        """[inner nodes, 2] R and e."""
        return self.shape.decode_spheres(
            _stacked(values, "spheres.radius", "spheres.extent"), sigmas
        )


def _stacked(values: Mapping[str, Column], *keys: str) -> UInt16:
    return np.stack([values[key] for key in keys], axis=1).astype(np.uint16)
