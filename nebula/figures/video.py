"""H.265 by libx265 (through PyAV): what a video of the same views would cost, and how it looks.

Low delay as for a headset: preset ``veryfast``, tune ``zerolatency``, one I frame at the start and
P frames after it, no B frames, no scene cuts, no look-ahead. Lossless RGB is coded in planar GBR
4:4:4 and gives back every bit. All other qualities are 8-bit 4:2:0 (BT.709, studio range), as
headsets decode it; what that conversion loses is in their error, and is all that "lossless 4:2:0"
loses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.parallel import threads

UInt8 = NDArray[np.uint8]

PRESET = "veryfast"


@dataclass(frozen=True)
class VideoQuality:
    """How a video is coded; ``crf`` is the constant rate factor of x265, None for lossless."""

    name: str
    crf: int | None
    pixel_format: str = "yuv420p"


QUALITIES = (
    VideoQuality("lossless RGB", None, "gbrp"),
    VideoQuality("lossless 4:2:0", None),
    VideoQuality("high, CRF 12", 12),
    VideoQuality("mid, CRF 18", 18),
    VideoQuality("low, CRF 24", 24),
)


@dataclass(frozen=True)
class EncodedVideo:
    """A coded sequence. Frame i is in packet i: nothing is reordered."""

    packets: tuple[bytes, ...]
    frames: tuple[UInt8, ...]  # [H, W, 3] as the receiver shows them

    def steady_mbps(self, rate_hz: float) -> float:
        """Rate of the P frames: of all packets but the first, over their frames."""
        sizes = [len(packet) for packet in self.packets[1:]]
        return 8e-6 * sum(sizes) * rate_hz / len(sizes)

    @property
    def first_bytes(self) -> int:
        """The I frame, headers included."""
        return len(self.packets[0])


def require_av() -> ModuleType:
    """PyAV. Raises InputError where it is missing or comes without libx265."""
    try:
        import av
    except ImportError as error:
        raise InputError(
            "video is coded by PyAV, which is not installed: pip install 'nebula-splat[video]'"
        ) from error
    if "libx265" not in av.codecs_available:
        raise InputError("PyAV must come with libx265, as its wheels from the package index do")
    return av


def transcode(frames: Sequence[UInt8], quality: VideoQuality, rate_hz: float) -> EncodedVideo:
    """Code frames [H, W, 3] of 8-bit RGB and decode them again.

    Raises InputError for fewer than two frames, and for an odd width or height (4:2:0 halves both).
    """
    av = require_av()
    if len(frames) < 2:
        raise InputError(f"a video must have at least 2 frames, not {len(frames)}")
    height, width, _ = frames[0].shape
    if width % 2 or height % 2:
        raise InputError(f"video width and height must be even, not {width} x {height}")
    encoder = _encoder(av, width, height, quality, rate_hz)
    packets: list[bytes] = []
    for number, frame in enumerate(frames):
        picture = _to_coded(av, frame, quality.pixel_format)
        picture.pts = number
        packets += [bytes(packet) for packet in encoder.encode(picture)]
    packets += [bytes(packet) for packet in encoder.encode(None)]
    decoded = _decode(av, packets)
    if not len(packets) == len(decoded) == len(frames):
        raise RuntimeError(
            f"{len(frames)} frames became {len(packets)} packets and {len(decoded)} pictures"
        )
    return EncodedVideo(tuple(packets), tuple(decoded))


def _encoder(av: Any, width: int, height: int, quality: VideoQuality, rate_hz: float) -> Any:
    encoder = av.CodecContext.create("libx265", "w")
    encoder.width, encoder.height = width, height
    encoder.pix_fmt = quality.pixel_format
    encoder.framerate = Fraction(rate_hz).limit_denominator(1000)
    encoder.time_base = 1 / encoder.framerate
    # info=0: no text about the encoder in the stream; how many threads decides no bits
    parameters = f"log-level=none:info=0:bframes=0:keyint=-1:scenecut=0:pools={threads()}"
    if quality.crf is None:
        parameters += ":lossless=1"
    encoder.options = {"preset": PRESET, "tune": "zerolatency", "x265-params": parameters}
    if quality.crf is not None:
        encoder.options = {**encoder.options, "crf": str(quality.crf)}
    return encoder


def _decode(av: Any, packets: Sequence[bytes]) -> list[UInt8]:
    decoder = av.CodecContext.create("hevc", "r")
    pictures = [picture for packet in packets for picture in decoder.decode(av.Packet(packet))]
    pictures += decoder.decode(None)
    return [_to_rgb(picture) for picture in pictures]


def _to_coded(av: Any, frame: UInt8, pixel_format: str) -> Any:
    picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
    if pixel_format == "gbrp":  # the same numbers, in planes
        return picture.reformat(format="gbrp")
    return picture.reformat(
        format=pixel_format,
        src_colorspace="ITU709",
        dst_colorspace="ITU709",
        src_color_range="JPEG",
        dst_color_range="MPEG",
    )


def _to_rgb(picture: Any) -> UInt8:
    if picture.format.name == "gbrp":
        rgb = picture.reformat(format="rgb24")
    else:
        rgb = picture.reformat(
            format="rgb24",
            src_colorspace="ITU709",
            dst_colorspace="ITU709",
            src_color_range="MPEG",
            dst_color_range="JPEG",
        )
    array: UInt8 = rgb.to_ndarray()
    return array
