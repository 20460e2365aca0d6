"""``lod-meta.json``: several complete levels of detail of one scene, stored as SOG data sets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaussians.errors import InputError
from gaussians.formats.files import (
    JSON_LIMIT_BYTES,
    integer,
    is_relative_name,
    member,
    parse_json_object,
    read_bounded,
)
from gaussians.formats.sog import read_sog
from gaussians.scene import Scene, concatenate

_COUNT_LIMIT = 2**31 - 1


class _Range(NamedTuple):
    """Rows ``start`` up to, not including, ``stop`` of one file."""

    file: int
    start: int
    stop: int


def read_lod_meta(path: Path, level: int) -> tuple[Scene, list[Path]]:
    """One level (0 = finest), leaf after leaf in the order of the tree, and the files read.

    A level is the union of the index ranges that the leaves list for it; a leaf that lists none has
    no Gaussians at that level. Files of other levels are not opened. Raises InputError for a level
    that does not exist, ranges that overlap or lie outside their file, names that leave the folder,
    and a scene with an ``environment``, which this reader does not know.
    """
    meta = parse_json_object(read_bounded(path, JSON_LIMIT_BYTES), str(path))
    levels = integer(meta, "lodLevels", str(path), 1, 64)
    if not 0 <= level < levels:
        raise InputError(f"{path}: level must be one of 0 (finest) to {levels - 1}, not {level}")
    if meta.get("environment") is not None:
        raise InputError(f"{path}: environment must be null, not {meta['environment']!r}")
    names = member(meta, "filenames", str(path))
    if not isinstance(names, list) or not all(is_relative_name(n) for n in names):
        raise InputError(f"{path}: filenames must be a list of relative paths inside the folder")
    ranges = list(_leaf_ranges(member(meta, "tree", str(path)), level, len(names), str(path)))
    if not any(r.stop > r.start for r in ranges):
        raise InputError(f"{path}: level {level} is empty: no leaf lists Gaussians for it")
    return _read_ranges(path, names, ranges)


def _leaf_ranges(tree: Any, level: int, files: int, name: str) -> Iterator[_Range]:
    """Ranges of one level, depth first, without recursion (trees may be deep)."""
    open_nodes = [tree]
    while open_nodes:
        node = open_nodes.pop()
        if isinstance(node, dict) and isinstance(node.get("children"), list):
            open_nodes.extend(reversed(node["children"]))
            continue
        lods = member(node, "lods", f"{name}: tree leaf")
        if not isinstance(lods, dict):
            raise InputError(f"{name}: tree leaf: lods must be an object")
        if str(level) in lods:
            entry, where = lods[str(level)], f"{name}: tree leaf, level {level}"
            start = integer(entry, "offset", where, 0, _COUNT_LIMIT)
            count = integer(entry, "count", where, 0, _COUNT_LIMIT)
            yield _Range(integer(entry, "file", where, 0, files - 1), start, start + count)


def _read_ranges(path: Path, names: list[str], ranges: list[_Range]) -> tuple[Scene, list[Path]]:
    """Open each file once and take its ranges in tree order."""
    scenes: dict[int, Scene] = {}
    files = [path]
    for index in sorted({r.file for r in ranges}):
        scenes[index], read = read_sog(path.parent / names[index])
        files += read
        reached = 0
        for _, start, stop in sorted(r for r in ranges if r.file == index):
            if start < reached:
                raise InputError(f"{path}: ranges of {names[index]} must not overlap")
            reached = stop
        if reached > len(scenes[index]):
            raise InputError(
                f"{path}: ranges of {names[index]} must end within its {len(scenes[index])} "
                f"Gaussians, not at {reached}"
            )
    parts = [scenes[r.file].take(np.arange(r.start, r.stop)) for r in ranges]
    return concatenate(parts), files
