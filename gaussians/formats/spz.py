"""SPZ versions 2 and 3: a gzip stream of a 16-byte header and one array per attribute.

Format: https://github.com/nianticlabs/spz (README and ``src/cc/load-spz.cc``). SPZ stores its axes
as RUB (x right, y up, z back); scenes here have the axes of INRIA PLY files, RDF (x right, y down,
z front). Reader and writer turn the scene by 180 degrees about x, which negates some components
and rounds nothing: y and z of means and quaternions, and the harmonics that are odd under it. So a
scene has the same axes from an SPZ as from the PLY it was made of. Tools that convert a PLY without
naming its axes store RDF: such a file comes out upside down, which ``--up +y`` puts right.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.formats.files import file_size, losses, read_bounded, write_atomically
from gaussians.formats.smallest_three import join_smallest_three, split_smallest_three
from gaussians.scene import Float32, Scene, normalised_quaternions

GZIP_MAGIC = b"\x1f\x8b"

_HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fraction bits, flags, zero
_MAGIC = 0x5053474E
_ANTIALIASED = 1  # how the scene was trained; not used
_GZIP = 16 + zlib.MAX_WBITS
# gzip makes SPZ files 1 to 3 times smaller; a file that would grow more than this is a bomb
_EXPANSION_LIMIT, _SMALL_BYTES = 100, 2**20
_HIGHER = (0, 3, 8, 15)  # coefficients above degree 0, by degree
_MOST_FRACTION_BITS = 23  # more would be steps below 1.2e-7 units
_MEAN_LIMIT = 2**23 - 1  # 24-bit signed integers
_COLOUR_SCALE = 0.15  # byte / 255 = 0.15 f_dc + 0.5
_SCALE_STEPS, _SCALE_LOWEST = 16.0, -10.0  # ln of a scale = byte / 16 - 10
_HARMONIC_STEPS = 128.0  # coefficient = (byte - 128) / 128
_HALF_SQRT, _MAGNITUDES = np.sqrt(0.5), 511.0  # version 3: sign and 9 bits, up to sqrt(1/2)
_FIRST_THREE_LIMIT = 1 + np.sqrt(3.0) / 127.5  # length of (x, y, z), each off by one step
# Signs under the half turn about x: of x, y, z; of w, x, y, z; of the coefficients of degree 1 to 3
_AXES = np.array([1, -1, -1], np.float32)
_QUATERNION = np.array([1, 1, -1, -1], np.float32)
_HARMONICS = np.array(
    [[-1], [-1], [1], [-1], [1], [1], [-1], [1], [-1], [1], [-1], [-1], [1], [-1], [1]], np.float32
)


class _Header(NamedTuple):
    magic: int
    version: int
    rows: int
    sh_degree: int
    fraction_bits: int
    flags: int
    reserved: int

    def row_bytes(self) -> tuple[int, ...]:
        """Bytes per Gaussian of means, opacities, colours, scales, rotations, harmonics."""
        return 9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * _HIGHER[self.sh_degree]


def read_spz(path: Path) -> Scene:
    """The Gaussians of an SPZ file of version 2 or 3, SH degree 0 to 3, with the axes of a PLY.

    The size is computed from the header and nothing beyond it is inflated. Raises InputError for
    other versions, extensions, degree 4, truncated, damaged or over-long streams, streams that
    expand more than a hundredfold (beyond 1 MiB) and rotations that are not of unit length.
    """
    header, body = _inflate(read_bounded(path, file_size(path)), path)
    ends = np.cumsum(header.row_bytes())[:-1] * header.rows
    means, opacities, colours, scales, rotations, harmonics = (
        part.reshape(header.rows, -1) for part in np.split(np.frombuffer(body, np.uint8), ends)
    )
    base = ((colours / 255.0 - 0.5) / _COLOUR_SCALE)[:, None, :]
    coefficients = _HIGHER[header.sh_degree]
    higher = (harmonics.reshape(header.rows, coefficients, 3) - 128.0) / _HARMONIC_STEPS
    higher *= _HARMONICS[:coefficients]
    return Scene(
        means=_means(means, header.fraction_bits) * _AXES,
        quaternions=_rotations(rotations, str(path)) * _QUATERNION,
        scales=np.exp(scales / _SCALE_STEPS + _SCALE_LOWEST).astype(np.float32),
        opacities=(opacities[:, 0] / 255.0).astype(np.float32),
        sh=np.concatenate([base, higher], axis=1).astype(np.float32),
    ).validate(str(path))


def _inflate(data: bytes, path: Path) -> tuple[_Header, bytes]:
    """The checked header and exactly the bytes that belong to it."""
    inflater = zlib.decompressobj(_GZIP)
    try:
        header = _check_header(inflater.decompress(data, _HEADER.size), path)
        size = header.rows * sum(header.row_bytes())
        if size > max(_SMALL_BYTES, _EXPANSION_LIMIT * len(data)):
            raise InputError(
                f"{path}: {len(data)} bytes must not expand to {header.rows} Gaussians"
            )
        body = inflater.decompress(inflater.unconsumed_tail, size + 1)
    except zlib.error as error:
        raise InputError(f"{path}: must be an intact gzip stream: {error}") from error
    if len(body) > size or inflater.unused_data:
        raise InputError(f"{path}: has trailing bytes after {header.rows} Gaussians")
    if len(body) < size or not inflater.eof:
        raise InputError(
            f"{path}: truncated: {header.rows} Gaussians must have {size} bytes and a checksum, "
            f"but only {len(body)} bytes were found"
        )
    return header, body


def _check_header(data: bytes, path: Path) -> _Header:
    if len(data) != _HEADER.size:
        raise InputError(f"{path}: truncated: an SPZ header must have {_HEADER.size} bytes")
    header = _Header(*_HEADER.unpack(data))
    if header.magic != _MAGIC:
        raise InputError(f"{path}: must begin with the SPZ header 'NGSP' inside gzip")
    if header.version not in (2, 3):
        raise InputError(f"{path}: SPZ version must be 2 or 3, not {header.version}")
    if header.rows == 0:
        raise InputError(f"{path}: empty: must hold at least one Gaussian")
    if header.sh_degree > 3:
        raise InputError(f"{path}: SH degree must be 0 to 3, not {header.sh_degree}")
    if header.fraction_bits > _MOST_FRACTION_BITS:
        raise InputError(
            f"{path}: fractional bits must be 0 to {_MOST_FRACTION_BITS}, "
            f"not {header.fraction_bits}"
        )
    if header.flags & ~_ANTIALIASED or header.reserved:
        raise InputError(
            f"{path}: SPZ flags must be 0 or 1 and the reserved byte 0, not {header.flags} and "
            f"{header.reserved}: extensions are not supported"
        )
    return header


def _means(stored: NDArray[np.uint8], fraction_bits: int) -> Float32:
    """[N, 3] from 24-bit signed fixed point, little-endian; exact in float32."""
    words = np.zeros((len(stored), 3, 4), np.uint8)
    words[:, :, 1:] = stored.reshape(
        -1, 3, 3
    )  # into the upper bytes, so the shift extends the sign
    return (words.view("<i4")[:, :, 0] >> 8).astype(np.float32) / np.float32(2**fraction_bits)


def _rotations(stored: NDArray[np.uint8], name: str) -> Float32:
    """[N, 4] unit quaternions (w, x, y, z); the files have x, y, z, w."""
    if stored.shape[1] == 4:
        word = np.ascontiguousarray(stored).view("<u4")
        fields = word >> np.array([20, 10, 0], np.uint32) & 1023
        kept = (fields & 511) * (_HALF_SQRT / _MAGNITUDES) * np.where(fields & 512, -1.0, 1.0)
        joined = join_smallest_three(kept, (word[:, 0] >> 30).astype(np.intp), name)
        return np.roll(joined, 1, axis=1)
    xyz = stored / 127.5 - 1.0
    squares = (xyz * xyz).sum(axis=1)
    if (squares > _FIRST_THREE_LIMIT**2).any():
        bad = int(np.argmax(squares))
        raise InputError(f"{name}: the rotation of Gaussian {bad} must be a unit quaternion")
    w = np.sqrt(np.maximum(1.0 - squares, 0.0))  # rounding may carry (x, y, z) beyond length 1
    return normalised_quaternions(np.concatenate([w[:, None], xyz], axis=1), name)


def write_spz(scene: Scene, path: Path) -> None:
    """Write a scene as SPZ version 3; the file is replaced in one step.

    Read back, with m the farthest coordinate of the scene, a mean changes by at most m / 8e6 or
    6e-8, whichever is larger (24 bits with the finest step that reaches m); an opacity by at most
    0.00197; f_dc by at most 0.0131 (0.0037 in colour); other coefficients by at most 1/256; ln of a
    scale by at most 1/32 (3.2 %); a quaternion returns with either sign, each component within
    0.0022.

    Raises InputError for an invalid or empty scene, for means beyond 8.3e6, and for what else the
    format cannot hold: see ``fit_spz``.
    """
    scene.validate(str(path))
    if not len(scene):
        raise InputError(f"{path}: an SPZ scene must hold at least one Gaussian")
    lost = fit_spz(scene)[1]
    if lost:
        raise InputError(f"{path}: SPZ cannot hold {losses(lost)}; drop them first")
    farthest = float(np.abs(scene.means).max())
    choices = range(_MOST_FRACTION_BITS, -1, -1)
    fraction_bits = next((b for b in choices if farthest * 2.0**b < _MEAN_LIMIT + 0.5), None)
    if fraction_bits is None:
        raise InputError(f"{path}: SPZ means must lie within {_MEAN_LIMIT} units, not {farthest:g}")
    packer = zlib.compressobj(wbits=_GZIP)
    blocks = (packer.compress(block) for block in _blocks(scene, fraction_bits))
    write_atomically(path, (*blocks, packer.flush()))


def _blocks(scene: Scene, fraction_bits: int) -> Iterator[bytes]:
    """The header and the arrays, in file order."""
    yield _HEADER.pack(_MAGIC, 3, len(scene), scene.sh_degree, fraction_bits, 0, 0)
    fixed = np.rint((scene.means * _AXES).astype(np.float64) * 2.0**fraction_bits).astype("<i4")
    yield fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    yield _bytes(scene.opacities * 255.0)
    yield _bytes((scene.sh[:, 0] * _COLOUR_SCALE + 0.5) * 255.0)
    yield _bytes((np.log(scene.scales.astype(np.float64)) - _SCALE_LOWEST) * _SCALE_STEPS)
    kept, omitted = split_smallest_three(np.roll(scene.quaternions * _QUATERNION, -1, axis=1))
    magnitudes = np.rint(np.abs(kept) * (_MAGNITUDES / _HALF_SQRT)).clip(0, _MAGNITUDES)
    fields = magnitudes.astype(np.uint32) | np.where(kept < 0, 512, 0).astype(np.uint32)
    word = omitted.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    yield word.astype("<u4").tobytes()
    yield _bytes(_stored_harmonics(scene) * _HARMONIC_STEPS + 128.0)


def _stored_harmonics(scene: Scene) -> NDArray[np.float32]:
    """[N, K, 3] coefficients above degree 0 in the axes of the file."""
    return scene.sh[:, 1:] * _HARMONICS[: scene.sh.shape[1] - 1]


def _bytes(steps: NDArray[np.floating]) -> bytes:
    return np.rint(steps).clip(0, 255).astype(np.uint8).tobytes()


def fit_spz(scene: Scene) -> tuple[Scene, dict[str, int]]:
    """The scene as an SPZ can hold it, and how many values changed, by what they were.

    Moved to the nearest limit: opacities above 1; scales outside e^-10..e^5.94 (4.5e-5..379);
    f_dc outside -3.33..3.33; other coefficients outside -1..0.992, in the axes of the file. Values
    within half a step of a limit count as inside. Means are never moved.
    """
    opacities, opaque = _limited(scene.opacities, 0.0, 1.0, 0.0)
    with np.errstate(divide="ignore"):  # ln 0 is -inf: outside
        logarithms = np.log(scene.scales.astype(np.float64))
    highest = _SCALE_LOWEST + 255 / _SCALE_STEPS
    limited, sizes = _limited(logarithms, _SCALE_LOWEST, highest, 0.5 / _SCALE_STEPS)
    scales = np.where(sizes, np.exp(limited), scene.scales)
    most = 0.5 / _COLOUR_SCALE
    base, bright = _limited(scene.sh[:, 0], -most, most, most / 255)
    higher, strong = _limited(
        _stored_harmonics(scene), -1.0, 127 / _HARMONIC_STEPS, 0.5 / _HARMONIC_STEPS
    )
    higher *= _HARMONICS[: scene.sh.shape[1] - 1]
    fitted = replace(
        scene,
        scales=scales.astype(np.float32),
        opacities=opacities.astype(np.float32),
        sh=np.concatenate([base[:, None], higher], axis=1).astype(np.float32),
    )
    changed = {
        "opacities above 1": opaque,
        "scales outside 4.5e-5..379": sizes,
        "base colours f_dc outside -3.33..3.33": bright,
        "harmonics outside -1..0.992": strong,
    }
    return fitted, {what: int(where.sum()) for what, where in changed.items() if where.any()}


def _limited(
    values: NDArray[np.floating], low: float, high: float, slack: float
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Values moved to the nearest limit where they lie beyond it by more than ``slack``; where."""
    outside = (values < low - slack) | (values > high + slack)
    return np.where(outside, values.clip(low, high), values), outside
