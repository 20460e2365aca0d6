"""Readers of trained scenes; one entry, ``load_scene``, for all formats."""

from __future__ import annotations

from pathlib import Path

from gaussians.errors import InputError
from gaussians.formats.files import JSON_LIMIT_BYTES, parse_json_object, read_bounded
from gaussians.formats.lod_meta import read_lod_meta
from gaussians.formats.ply import read_ply, write_ply
from gaussians.formats.sog import read_sog
from gaussians.formats.splat import read_splat
from gaussians.scene import Scene

__all__ = ["load_scene", "write_ply"]

_KNOWN = "INRIA .ply, .splat, SOG (.sog, meta.json) or lod-meta.json"


def load_scene(path: Path, level: int | None = None) -> tuple[Scene, list[Path]]:
    """A validated scene in the units of its file, and every file that was read.

    The extension decides between INRIA ``.ply``, ``.splat``, SOG ``.sog`` and JSON (``meta.json``
    of a SOG folder, or ``lod-meta.json``); without a known extension the first bytes do. A folder
    stands for the ``lod-meta.json`` or ``meta.json`` in it. ``level`` picks one level of a
    ``lod-meta.json`` (0 = finest, the default).

    Raises InputError for anything else, for damaged or empty scenes, and for a ``level`` where the
    format has none.
    """
    file = _file_of(path)
    kind = _kind_of(file)
    if kind == "lod":
        return read_lod_meta(file, 0 if level is None else level)
    if level is not None:
        raise InputError(f"{file}: level {level} was asked for, but only lod-meta.json has levels")
    if kind == "sog":
        return read_sog(file)
    return (read_ply if kind == "ply" else read_splat)(file), [file]


def _file_of(path: Path) -> Path:
    """The file that a scene path stands for."""
    if not path.exists():
        raise InputError(f"{path}: scene does not exist")
    if not path.is_dir():
        return path
    found = [path / name for name in ("lod-meta.json", "meta.json") if (path / name).exists()]
    if len(found) != 1:
        raise InputError(
            f"{path}: a scene folder must hold either lod-meta.json or meta.json, not "
            f"{'both' if found else 'neither'}"
        )
    return found[0]


def _kind_of(file: Path) -> str:
    """``ply``, ``splat``, ``sog`` or ``lod``."""
    suffix = file.suffix.lower()
    if suffix in (".ply", ".splat", ".sog"):
        return suffix[1:]
    if suffix == ".json":
        document = parse_json_object(read_bounded(file, JSON_LIMIT_BYTES), str(file))
        return "lod" if "lodLevels" in document else "sog"
    try:
        with file.open("rb") as stream:
            start = stream.read(4)
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    if start[:3] == b"ply":
        return "ply"
    if start == b"PK\x03\x04":
        return "sog"
    raise InputError(f"{file}: must be a scene in one of the formats {_KNOWN}")
