"""Readers and writers of trained scenes: ``load_scene`` and ``save_scene`` for all formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gaussians.errors import InputError
from gaussians.formats.compressed_ply import is_compressed_ply, read_compressed_ply
from gaussians.formats.files import JSON_LIMIT_BYTES, file_size, parse_json_object, read_bounded
from gaussians.formats.layout import compose_layout
from gaussians.formats.lod_meta import LodSet, load_lod_set
from gaussians.formats.ply import fit_ply, iterate_ply, read_ply, write_ply
from gaussians.formats.sog import read_sog
from gaussians.formats.splat import fit_splat, iterate_splat, read_splat, write_splat
from gaussians.formats.spz import GZIP_MAGIC, fit_spz, read_spz, write_spz
from gaussians.scene import Scene

__all__ = [
    "LodSet",
    "fit_scene",
    "iterate_ply",
    "iterate_splat",
    "load_lod_set",
    "load_scene",
    "save_scene",
    "write_ply",
    "write_splat",
    "write_spz",
]

_KNOWN = "INRIA .ply, compressed .ply, .splat, .spz, SOG (.sog, meta.json), "
_KNOWN += "lod-meta.json or V3DG layout .json"
_READERS: dict[str, Callable[[Path], Scene]] = {
    "ply": read_ply,
    "splat": read_splat,
    "spz": read_spz,
}
_Writer = Callable[[Scene, Path], None]
_Fit = Callable[[Scene], tuple[Scene, dict[str, int]]]
_WRITERS: dict[str, tuple[_Writer, _Fit]] = {
    ".ply": (write_ply, fit_ply),
    ".splat": (write_splat, fit_splat),
    ".spz": (write_spz, fit_spz),
}


def load_scene(path: Path | str, level: int | None = None) -> tuple[Scene, list[Path]]:
    """A validated scene in the units of its file, and every file that was read.

    The extension decides between ``.ply`` (INRIA's, or PlayCanvas' compressed one, by its header),
    ``.splat``, ``.spz``, SOG ``.sog`` and JSON (``meta.json`` of a SOG folder, ``lod-meta.json``,
    or a V3DG layout, which is composed: `layout.compose_layout`); without a known extension the
    first bytes do. A folder stands for the ``lod-meta.json`` or ``meta.json`` in it. ``level``
    picks one level of a ``lod-meta.json`` (0 = finest, the default).

    Raises InputError for anything else, for damaged or empty scenes, and for a ``level`` where the
    format has none.
    """
    file = _file_of(Path(path))
    kind = _kind_of(file)
    if kind == "lod":
        chosen = 0 if level is None else level
        lod_set = load_lod_set(file, [chosen])
        return lod_set.levels[chosen], lod_set.files
    if level is not None:
        raise InputError(f"{file}: level {level} was asked for, but only lod-meta.json has levels")
    if kind == "sog":
        return read_sog(file)
    if kind == "layout":
        return compose_layout(file)
    if kind == "ply" and is_compressed_ply(file):
        return read_compressed_ply(file), [file]
    return _READERS[kind](file), [file]


def save_scene(scene: Scene, path: Path | str) -> None:
    """Write a scene as INRIA ``.ply``, ``.splat`` or ``.spz``; the file is replaced in one step.

    What each format keeps stands at its writer (``write_ply``, ``write_splat``, ``write_spz``).
    Raises InputError for another extension, an invalid or empty scene, and a scene that the format
    cannot hold, naming what would be lost; ``fit_scene`` gives that up beforehand.
    """
    write, _ = _writer_of(Path(path))
    write(scene, Path(path))


def fit_scene(scene: Scene, path: Path | str) -> tuple[Scene, dict[str, int]]:
    """The scene as the format of ``path`` can hold it, and what that changed.

    The dictionary counts the changed values by what they were, such as
    ``{"opacities above 1": 3}``; it is empty when nothing changed. Rounding within the stated
    errors is not counted.
    """
    _, fit = _writer_of(Path(path))
    return fit(scene)


def _writer_of(path: Path) -> tuple[_Writer, _Fit]:
    if path.suffix.lower() not in _WRITERS:
        raise InputError(f"{path}: the extension must be one of {', '.join(_WRITERS)}")
    return _WRITERS[path.suffix.lower()]


def _file_of(path: Path) -> Path:
    """The file that a scene path stands for."""
    try:
        if not path.exists():
            raise InputError(f"{path}: scene does not exist")
    except OSError as error:  # no permission, or a name that is too long
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
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
    """``ply``, ``splat``, ``spz``, ``sog``, ``lod`` or ``layout``."""
    suffix = file.suffix.lower()
    if suffix in (".ply", ".splat", ".spz", ".sog"):
        return suffix[1:]
    if suffix == ".hier":
        raise InputError(
            f"{file}: must be a scene, not a .hier hierarchy, whose layout no free description "
            "tells (docs/formats.md); convert its leaves to .ply and build a tree of them"
        )
    if suffix == ".json":
        document = parse_json_object(read_bounded(file, JSON_LIMIT_BYTES), str(file))
        if "layouts" in document:
            return "layout"
        return "lod" if "lodLevels" in document else "sog"
    file_size(file)
    try:
        with file.open("rb") as stream:
            start = stream.read(4)
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    if start[:3] == b"ply":
        return "ply"
    if start[:2] == GZIP_MAGIC:
        return "spz"
    if start == b"PK\x03\x04":
        return "sog"
    raise InputError(f"{file}: must be a scene in one of the formats {_KNOWN}")
