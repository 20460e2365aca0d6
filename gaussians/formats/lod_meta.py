"""``lod-meta.json``: several complete levels of detail of one scene, stored as SOG data sets.

A tree of boxes; each leaf names, per level, a contiguous range of one file. Specification:
https://github.com/playcanvas/splat-transform (``guides/STREAMED_SOG_FORMAT.md``), version 1 and the
files from before it was numbered.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.formats.files import (
    JSON_LIMIT_BYTES,
    integer,
    is_relative_name,
    member,
    numbers,
    parse_json_object,
    read_bounded,
    shown,
)
from gaussians.formats.sog import read_sog
from gaussians.scene import Scene, concatenate

_COUNT_LIMIT = 2**31 - 1
_LEVELS_LIMIT = 64


@dataclass(frozen=True)
class LodSet:
    """The levels of detail of one scene that are at hand, cut into the same L leaves.

    Each level is a complete scene whose Gaussians stand leaf after leaf. Owns no rule that chooses
    a level.
    """

    level_count: int  # levels that the scene was published with; 0 is the finest
    levels: dict[int, Scene]  # those present, by level
    leaf_boxes: NDArray[np.float64]  # [L, 2, 3] least and most corner, units of the scene
    leaf_ranges: dict[int, NDArray[np.int64]]  # [L, 2] (offset, count) within the level's scene
    files: list[Path]  # every file that was read

    def leaf(self, leaf: int, level: int) -> Scene:
        """The Gaussians of one leaf at one level (copied; none where the leaf has none)."""
        offset, count = self.leaf_ranges[level][leaf]
        return self.levels[level].take(np.arange(offset, offset + count))


class _Range(NamedTuple):
    """Rows ``start`` up to, not including, ``stop`` of one file."""

    file: int
    start: int
    stop: int


def load_lod_set(path: Path | str, levels: Collection[int] | None = None) -> LodSet:
    """The levels of a ``lod-meta.json``: those asked for, or all whose files are present.

    A level is the union of the index ranges that the leaves list for it; a leaf that lists none has
    no Gaussians at that level. A level none of whose files exists counts as left out; one that
    lacks some of them is damaged. Files of levels not asked for are not opened.

    Raises InputError for a level that does not exist, is empty or was asked for but left out, no
    level at all, ranges that overlap or lie outside their file, counts that contradict the ranges,
    names that leave the folder or repeat, another version, and a scene with an ``environment``,
    which this reader does not know.
    """
    path = Path(path)
    meta = parse_json_object(read_bounded(path, JSON_LIMIT_BYTES), str(path))
    if meta.get("version", 1) != 1:
        raise InputError(f"{path}: version must be 1, not {shown(meta['version'])}")
    level_count = integer(meta, "lodLevels", str(path), 1, _LEVELS_LIMIT)
    for level in levels or ():
        if not 0 <= level < level_count:
            raise InputError(
                f"{path}: level must be one of 0 (finest) to {level_count - 1}, not {level}"
            )
    if meta.get("environment") is not None:
        raise InputError(f"{path}: environment must be null, not {shown(meta['environment'])}")
    names = _file_names(meta, path)
    leaves = list(_leaves(member(meta, "tree", str(path)), str(path)))
    boxes = np.array([_box(leaf, str(path)) for leaf in leaves])
    chosen = range(level_count) if levels is None else sorted(set(levels))
    scenes: dict[int, Scene] = {}
    ranges: dict[int, NDArray[np.int64]] = {}
    files = [path]
    for level in chosen:
        listed = [_range(leaf, level, len(names), str(path)) for leaf in leaves]
        _check_counts(meta, level, listed, path)
        if levels is None and _is_left_out(path, names, listed):
            continue
        scenes[level], read = _read_level(path, names, listed, level)
        counts = np.array([r.stop - r.start for r in listed], np.int64)
        ranges[level] = np.stack([np.cumsum(counts) - counts, counts], axis=1)
        files += read
    if not scenes:
        raise InputError(f"{path}: no level of the scene is present")
    return LodSet(level_count, scenes, boxes, ranges, files)


def _file_names(meta: dict[str, Any], path: Path) -> list[str]:
    names = member(meta, "filenames", str(path))
    if not isinstance(names, list) or not all(is_relative_name(n) for n in names):
        raise InputError(f"{path}: filenames must be a list of relative paths inside the folder")
    if len(set(names)) != len(names):  # a small list could otherwise ask for one file many times
        raise InputError(f"{path}: filenames must not repeat")
    return names


def _leaves(tree: Any, name: str) -> Iterator[dict[str, Any]]:
    """The leaves, depth first, without recursion (trees may be deep)."""
    open_nodes = [tree]
    while open_nodes:
        node = open_nodes.pop()
        if isinstance(node, dict) and isinstance(node.get("children"), list):
            open_nodes.extend(reversed(node["children"]))
            continue
        if not isinstance(member(node, "lods", f"{name}: tree leaf"), dict):
            raise InputError(f"{name}: tree leaf: lods must be an object")
        yield node


def _box(leaf: dict[str, Any], name: str) -> list[list[float]]:
    """Least and most corner of a leaf."""
    where = f"{name}: tree leaf: bound"
    bound = member(leaf, "bound", f"{name}: tree leaf")
    low, high = numbers(bound, "min", where, 3), numbers(bound, "max", where, 3)
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise InputError(f"{where}: min must not exceed max")
    return [low, high]


def _range(leaf: dict[str, Any], level: int, files: int, name: str) -> _Range:
    """What a leaf lists for one level; an empty range of no file where it lists nothing."""
    if str(level) not in leaf["lods"]:
        return _Range(-1, 0, 0)
    entry, where = leaf["lods"][str(level)], f"{name}: tree leaf, level {level}"
    start = integer(entry, "offset", where, 0, _COUNT_LIMIT)
    count = integer(entry, "count", where, 0, _COUNT_LIMIT)
    return _Range(integer(entry, "file", where, 0, files - 1), start, start + count)


def _check_counts(meta: dict[str, Any], level: int, listed: list[_Range], path: Path) -> None:
    """Raise InputError where the document states another count for this level."""
    total = sum(r.stop - r.start for r in listed)
    if total == 0:
        raise InputError(f"{path}: level {level} is empty: no leaf lists Gaussians for it")
    counts = meta.get("counts")
    if counts is None:
        return
    if not isinstance(counts, list) or len(counts) <= level or counts[level] != total:
        raise InputError(
            f"{path}: counts must state the {total} Gaussians that the leaves list for level "
            f"{level}, not {shown(counts)}"
        )


def _is_left_out(path: Path, names: list[str], listed: list[_Range]) -> bool:
    """Whether no file of this level exists."""
    used = {names[r.file] for r in listed if r.stop > r.start}
    return not any((path.parent / name).exists() for name in used)


def _read_level(
    path: Path, names: list[str], listed: list[_Range], level: int
) -> tuple[Scene, list[Path]]:
    """Open each file once and take its ranges in the order of the leaves."""
    by_file: dict[int, list[_Range]] = {}
    filled = [r for r in listed if r.stop > r.start]
    for part in filled:
        by_file.setdefault(part.file, []).append(part)
    scenes: dict[int, Scene] = {}
    files: list[Path] = []
    for index in sorted(by_file):
        scenes[index], read = read_sog(path.parent / names[index])
        files += read
        reached = 0
        for _, start, stop in sorted(by_file[index]):
            if start < reached:
                raise InputError(
                    f"{path}: ranges of {names[index]} must not overlap at level {level}"
                )
            reached = stop
        if reached > len(scenes[index]):
            raise InputError(
                f"{path}: ranges of {names[index]} must end within its {len(scenes[index])} "
                f"Gaussians, not at {reached}"
            )
    return concatenate([scenes[r.file].take(np.arange(r.start, r.stop)) for r in filled]), files
