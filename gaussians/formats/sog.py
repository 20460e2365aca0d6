"""SOG version 2: quantised Gaussians in lossless WebP images beside a ``meta.json``.

Either a folder or the same files in one zip archive (``.sog``). Gaussian i is pixel i, row by row;
pixels from ``count`` on are padding. Only files that ``meta.json`` names are read.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.formats.files import (
    JSON_LIMIT_BYTES,
    file_names,
    file_size,
    integer,
    member,
    numbers,
    parse_json_object,
    read_bounded,
    shown,
)
from gaussians.formats.smallest_three import join_smallest_three
from gaussians.formats.webp import PIXEL_LIMIT, decode_lossless_webp
from gaussians.scene import Scene

_CODEBOOK_SIZE = 256
_PALETTE_COLUMNS = 64  # palette entries per row of the centroid image
_PALETTE_LIMIT = 65536  # labels have 16 bits
_COEFFICIENTS_OF_BANDS = {1: 3, 2: 8, 3: 15}
_OMITTED_BASE = 252  # alpha of the quaternion image minus this = index of the omitted component
_PIXEL_BYTES = 8  # a lossless WebP of a sane encoder stays below this many bytes per pixel
_OVERHEAD_BYTES = 2**20
# Positions of real scenes have about one pixel per byte; a bomb has thousands
_PIXELS_PER_BYTE, _SMALL_PIXELS = 100, 2**16
# What zipfile raises for damaged archives; a ValueError is a wrong offset or a name not in UTF-8
_ZIP_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError),
    *(ValueError, OverflowError, struct.error),
)

_ReadFile = Callable[[str, int], bytes]  # (name, most bytes) to content


def read_sog(path: Path) -> tuple[Scene, list[Path]]:
    """The Gaussians of a ``.sog`` archive or of a ``meta.json``, and the files read.

    Hints that hold no Gaussian (``asset``, ``antialias``) are not used. Raises InputError for
    another version, missing or oversized files, names with folders, lossy or too small images,
    indices outside their tables and damaged quaternions.
    """
    if path.suffix != ".json":
        return _read_archive(path), [path]
    files = [path]

    def read_file(name: str, limit: int) -> bytes:
        file = path.parent / name
        files.append(file)
        return read_bounded(file, limit)

    return _read_images(read_bounded(path, JSON_LIMIT_BYTES), read_file, str(path)), files


def _read_archive(path: Path) -> Scene:
    """Gaussians of a zip archive; nothing is unpacked to disk."""
    file_size(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            names = [info.filename for info in archive.infolist()]

            def read_file(name: str, limit: int) -> bytes:
                if names.count(name) != 1:
                    raise InputError(
                        f"{path}: must hold {name!r} exactly once, not {names.count(name)} times"
                    )
                return _read_member(archive, members[name], limit, path)

            meta = read_file("meta.json", JSON_LIMIT_BYTES)
            return _read_images(meta, read_file, str(path))
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _ZIP_ERRORS as error:
        what = shown(str(error))
        raise InputError(f"{path}: must be an intact, unencrypted zip archive: {what}") from error


def _read_member(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, limit: int, path: Path
) -> bytes:
    """One file of the archive, inflated no further than ``limit``, whatever the directory says."""
    if member.file_size > limit:
        raise InputError(f"{path}: {member.filename} must hold at most {limit} bytes")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        # the other methods inflate without a bound in Python's library
        raise InputError(f"{path}: {member.filename} must be stored or deflated in the archive")
    with archive.open(member) as stream:
        content = stream.read(member.file_size + 1)
    if len(content) != member.file_size:
        raise InputError(
            f"{path}: {member.filename} must hold {member.file_size} bytes, not {len(content)}"
        )
    return content


def _read_images(meta_json: bytes, read_file: _ReadFile, name: str) -> Scene:
    """Decode all properties of one SOG data set."""
    meta = parse_json_object(meta_json, name)
    if meta.get("version") != 2:
        raise InputError(f"{name}: SOG version must be 2, not {shown(meta.get('version'))}")
    count = integer(meta, "count", name, 0, PIXEL_LIMIT)
    if count == 0:
        raise InputError(f"{name}: empty: must hold at least one Gaussian")
    images = _Images(meta, count, read_file, name)
    means = _means(images)
    opacities, base_colour = _opacity_and_colour(images)
    harmonics = [base_colour]
    if meta.get("shN") is not None:
        harmonics.append(_higher_harmonics(images))
    with np.errstate(over="ignore"):  # inf is refused by validate()
        scale_of_byte = np.exp(images.codebook("scales")).astype(np.float32)
    scales = scale_of_byte[images.pixels("scales")[0][:, :3]]
    return Scene(
        means, _quaternions(images), scales, opacities, np.concatenate(harmonics, axis=1)
    ).validate(name)


class _Images:
    """The images and tables that one ``meta.json`` names, with its checks."""

    def __init__(self, meta: dict[str, Any], count: int, read_file: _ReadFile, name: str) -> None:
        self.meta, self.count, self.name = meta, count, name
        self._read_file = read_file

    def group(self, key: str) -> Any:
        """The object of one property, such as ``means``."""
        return member(self.meta, key, self.name)

    def numbers(self, key: str, field: str, length: int) -> NDArray[np.float64]:
        """A list of numbers of one property."""
        return np.array(numbers(self.group(key), field, f"{self.name}: {key}", length))

    def codebook(self, key: str) -> NDArray[np.float64]:
        """[256] values by byte."""
        return self.numbers(key, "codebook", _CODEBOOK_SIZE)

    def pixels(self, key: str, files: int = 1) -> list[NDArray[np.uint8]]:
        """[count, 4] RGBA bytes of each of the property's images; the first of two is bounded."""
        names = file_names(self.group(key), "files", f"{self.name}: {key}", files)
        images = (self.image(file, bounded=files > 1 and i == 0) for i, file in enumerate(names))
        return [image.reshape(-1, 4)[: self.count] for image in images]

    def image(
        self, file: str, least: int | None = None, bounded: bool = False
    ) -> NDArray[np.uint8]:
        """[height, width, 4] of one file with at least ``least`` pixels (default: count).

        ``bounded`` refuses an image whose bytes could not hold that many different pixels.
        """
        least = self.count if least is None else least
        most = min(4 * least + 65536, PIXEL_LIMIT)  # room for padding, not for a bomb
        data = self._read_file(file, _PIXEL_BYTES * most + _OVERHEAD_BYTES)
        if bounded and least > _SMALL_PIXELS + _PIXELS_PER_BYTE * len(data):
            raise InputError(
                f"{self.name}: {file}: {len(data)} bytes must not expand to {least} Gaussians"
            )
        return decode_lossless_webp(data, f"{self.name}: {file}", least, most)


def _means(images: _Images) -> NDArray[np.float32]:
    """[N, 3]: 16-bit positions in a box of the signed logarithm ``sign(x) ln(1 + |x|)``.

    Decoded before all other images: its size bounds what a small file can make of itself.
    """
    low, high = images.pixels("means", files=2)
    minimum, maximum = images.numbers("means", "mins", 3), images.numbers("means", "maxs", 3)
    if (minimum > maximum).any():
        raise InputError(f"{images.name}: means: mins must not exceed maxs")
    quantised = low[:, :3] + 256.0 * high[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # inf and NaN are refused by validate()
        logarithm = minimum + (maximum - minimum) * (quantised / 65535.0)
        return (np.sign(logarithm) * np.expm1(np.abs(logarithm))).astype(np.float32)


def _quaternions(images: _Images) -> NDArray[np.float32]:
    """[N, 4] from three components each; the omitted one is the largest and positive."""
    (pixels,) = images.pixels("quats")
    omitted = pixels[:, 3].astype(np.intp) - _OMITTED_BASE
    if (omitted < 0).any():
        bad = int(np.argmin(omitted))
        raise InputError(
            f"{images.name}: quats: alpha must be {_OMITTED_BASE} to 255; Gaussian {bad} has "
            f"{pixels[bad, 3]}"
        )
    kept = (pixels[:, :3] / 255.0 * 2.0 - 1.0) / np.sqrt(2.0)
    return join_smallest_three(kept, omitted, f"{images.name}: quats")


def _opacity_and_colour(images: _Images) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Activated opacities [N] and degree-0 coefficients [N, 1, 3]."""
    (pixels,) = images.pixels("sh0")
    codebook = _rounded(images.codebook("sh0"))
    return (pixels[:, 3] / 255.0).astype(np.float32), codebook[pixels[:, None, :3]]


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """To float32; what is too large becomes inf, which validate() refuses where it is used."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _higher_harmonics(images: _Images) -> NDArray[np.float32]:
    """[N, 3 | 8 | 15, 3]: each Gaussian's label picks an entry of a palette."""
    name, group = f"{images.name}: shN", images.group("shN")
    coefficients = _COEFFICIENTS_OF_BANDS[integer(group, "bands", name, 1, 3)]
    entries = integer(group, "count", name, 1, _PALETTE_LIMIT)
    centroids_file, labels_file = file_names(group, "files", name, 2)
    width, height = _PALETTE_COLUMNS * coefficients, -(-entries // _PALETTE_COLUMNS)
    centroids = images.image(centroids_file, least=width * height)
    if centroids.shape[1] != width:
        raise InputError(f"{name}: {centroids_file} must be {width} wide, not {centroids.shape[1]}")
    label_pixels = images.image(labels_file).reshape(-1, 4)[: images.count]
    labels = label_pixels[:, 0] + 256 * label_pixels[:, 1].astype(np.intp)
    if labels.max() >= entries:
        bad = int(np.argmax(labels))
        raise InputError(
            f"{name}: labels must be below count {entries}; Gaussian {bad} has {labels[bad]}"
        )
    codebook = _rounded(images.codebook("shN"))
    palette = codebook[centroids[:, :, :3]].reshape(-1, coefficients, 3)
    return palette[labels]
