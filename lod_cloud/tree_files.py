"""A tree on disk: a directory of .npy arrays, which can be memory-mapped, and tree.json."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.scene import FIELDS, Scene
from lod_cloud.lod_tree import ARRAYS, LodTree, Point, TreeMetadata

FORMAT = "nebula LoD tree"
VERSION = 1
_DESCRIPTION = "tree.json"
_READ_BYTES = 1 << 22


def save_tree(tree: LodTree, directory: str | os.PathLike[str]) -> None:
    """Write ``tree`` to ``directory``, all or nothing.

    Everything is written to a directory beside it, which then takes the name. An existing tree is
    replaced, an empty directory used; any other existing file or directory raises InputError, and
    so does a place that cannot be written.
    """
    target = Path(directory)
    if target.exists() and not _replaceable(target):
        raise InputError(f"{target}: must not exist, be empty, or hold a tree ({_DESCRIPTION})")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from error
    try:
        fresh = scratch / "new"
        fresh.mkdir()
        _write(tree, fresh)
        if target.exists():
            target.rename(scratch / "old")
        fresh.rename(target)
    except OSError as error:
        if (scratch / "old").exists() and not target.exists():
            (scratch / "old").rename(target)
        raise InputError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def load_tree(directory: str | os.PathLike[str]) -> LodTree:
    """The tree in ``directory``, memory-mapped (changes to its arrays stay in memory).

    Every byte is compared with its checksum first. Raises InputError when a file is missing,
    truncated, altered, or of an unknown version.
    """
    source = Path(directory)
    description = _read_description(source)
    arrays = {
        name: _read_array(source, name, entry) for name, entry in description["arrays"].items()
    }
    wanted = {*ARRAYS, *FIELDS}
    if set(arrays) != wanted:
        raise InputError(f"{source}: {_DESCRIPTION} must list the arrays {sorted(wanted)}")
    scene = Scene(*(arrays.pop(name) for name in FIELDS))
    tree = LodTree(gaussians=scene, metadata=_metadata(description["metadata"]), **arrays)
    counts = _counts(tree)
    if counts != description["counts"]:
        raise InputError(f"{source}: counts must be {description['counts']}, not {counts}")
    return tree


def _replaceable(target: Path) -> bool:
    return target.is_dir() and ((target / _DESCRIPTION).is_file() or not any(target.iterdir()))


def _write(tree: LodTree, folder: Path) -> None:
    entries = {}
    arrays = {name: getattr(tree, name) for name in ARRAYS}
    arrays |= {name: getattr(tree.gaussians, name) for name in FIELDS}
    for name, array in arrays.items():
        path = folder / f"{name}.npy"
        np.save(path, array, allow_pickle=False)
        entries[name] = {"bytes": path.stat().st_size, "sha256": _sha256(path)}
    description: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "counts": _counts(tree),
        "metadata": dataclasses.asdict(tree.metadata),
        "arrays": entries,
    }
    description["sha256"] = _digest(description)
    text = json.dumps(description, indent=1, allow_nan=False)
    (folder / _DESCRIPTION).write_text(text, encoding="utf-8")


def _counts(tree: LodTree) -> dict[str, int]:
    return {
        "nodes": len(tree),
        "leaves": tree.leaves,
        "levels": tree.levels,
        "sh_degree": tree.sh_degree,
    }


def _metadata(fields: dict[str, Any]) -> TreeMetadata:
    """Lists of JSON back to tuples."""

    def point(values: list[float]) -> Point:
        x, y, z = values
        return x, y, z

    low, high = fields["bounds"]
    return TreeMetadata(
        bounds=(point(low), point(high)),
        up=point(fields["up"]),
        units_per_metre=fields["units_per_metre"],
        start=None if fields["start"] is None else point(fields["start"]),
        path=tuple(point(p) for p in fields["path"]),
        build=fields["build"],
    )


def _digest(description: dict[str, Any]) -> str:
    """Checksum of the description itself, without the checksum."""
    fields = {name: value for name, value in description.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_READ_BYTES):
            digest.update(block)
    return digest.hexdigest()


def _read_description(source: Path) -> dict[str, Any]:
    path = source / _DESCRIPTION
    try:
        description = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path}: must be JSON: {error}") from error
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise InputError(f"{path}: format must be {FORMAT!r}")
    if description.get("version") != VERSION:
        raise InputError(f"{path}: version must be {VERSION}, not {description.get('version')}")
    if description.get("sha256") != _digest(description):
        raise InputError(f"{path}: checksum must match; the file was altered")
    return description


def _read_array(source: Path, name: str, entry: dict[str, Any]) -> NDArray[Any]:
    path = source / f"{name}.npy"
    try:
        size = path.stat().st_size
        if size != entry["bytes"]:
            raise InputError(f"{path}: must have {entry['bytes']} bytes, not {size}")
        if _sha256(path) != entry["sha256"]:
            raise InputError(f"{path}: checksum must match; the file was altered")
        # copy-on-write rather than read-only: numba compiles read-only arrays separately
        return np.asarray(np.load(path, mmap_mode="c", allow_pickle=False))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
