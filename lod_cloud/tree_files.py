"""A tree on disk: a directory of .npy arrays, which can be memory-mapped, and tree.json.

*What is checked when*: `load_tree` always compares every file's size with tree.json (truncated
files are refused) and the checksum of tree.json itself. An array's own checksum is compared when
the file is small, or when its modification time is no longer the one all files of a tree share
since they were written (it was touched, altered, or copied without ``cp -p``). An undisturbed
large tree is therefore opened without reading it; `verify_tree` reads every byte.

Beside the tree's own arrays a directory holds those that searches read (`lod_cloud.search_arrays`):
they follow from the others, and are there to be mapped instead of made. `verify_tree` compares.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gaussians.errors import InputError
from gaussians.parallel import run_chunks, threads
from gaussians.scene import FIELDS, Scene
from lod_cloud.array_file import ArrayFile
from lod_cloud.lod_tree import ARRAYS, LodTree, Point, TreeMetadata
from lod_cloud.search_arrays import SearchArrays
from lod_cloud.search_files import (
    SEARCH_FILES,
    compare_search_arrays,
    search_array_shapes,
    write_search_arrays,
)

FORMAT = "nebula LoD tree"
VERSION = 2
_READABLE = (1, 2)  # 1 had no search arrays
_DESCRIPTION = "tree.json"
_READ_BYTES = 1 << 22
_ALWAYS_CHECKED_BYTES = 1 << 24
_BACKDATED_S = 10  # any later change gets a later time, however coarse the file system's clock


def save_tree(tree: LodTree, directory: str | os.PathLike[str]) -> None:
    """Write ``tree`` to ``directory``, all or nothing.

    Everything is written to a directory beside it, which then takes the name. An existing tree is
    replaced, an empty directory used; any other existing file or directory raises InputError, and
    so does a place that cannot be written.
    """
    counts = {
        "nodes": len(tree),
        "leaves": tree.leaves,
        "levels": tree.levels,
        "sh_degree": tree.sh_degree,
    }
    with TreeWriter(directory, counts, tree.metadata) as writer:
        for name in ARRAYS:
            writer.put(name, getattr(tree, name))
        for name in FIELDS:
            writer.put(name, getattr(tree.gaussians, name))
        writer.finish()


def load_tree(directory: str | os.PathLike[str]) -> LodTree:
    """The tree in ``directory``, memory-mapped (changes to its arrays stay in memory).

    Memory and reading are those of the pages a user touches. Raises InputError when a file is
    missing, truncated, known to be altered (see above), or of an unknown version.
    """
    return _load(Path(directory), thorough=False)


def verify_tree(directory: str | os.PathLike[str]) -> LodTree:
    """`load_tree`, after every byte was compared with its checksum and every rule of `LodTree`."""
    source = Path(directory)
    tree = _load(source, thorough=True).validate(str(source))
    compare_search_arrays(source, tree)
    return tree


def _load(source: Path, *, thorough: bool) -> LodTree:
    description = _read_description(source)
    stamp = (source / _DESCRIPTION).stat().st_mtime_ns
    wanted = {*ARRAYS, *FIELDS}
    if description["version"] > 1:
        wanted |= {*SEARCH_FILES}
    if set(description["arrays"]) != wanted:
        raise InputError(f"{source}: {_DESCRIPTION} must list the arrays {sorted(wanted)}")
    arrays: dict[str, Any] = {
        name: _read_array(source, name, entry, None if thorough else stamp)
        for name, entry in description["arrays"].items()
    }
    derived = None
    if description["version"] > 1:
        derived = SearchArrays(*(arrays.pop(name) for name in SEARCH_FILES))
    scene = Scene(*(arrays.pop(name) for name in FIELDS))
    tree = LodTree(
        gaussians=scene,
        metadata=_metadata(description["metadata"]),
        search_arrays=derived,
        **arrays,
    )
    counts = {"nodes": len(tree), "levels": tree.levels, "sh_degree": tree.sh_degree}
    said = {name: description["counts"][name] for name in counts}
    if counts != said or any(len(array) != len(tree) for array in _per_node(tree)):
        raise InputError(f"{source}: counts must be {said}, not {counts}")
    return tree


def _per_node(tree: LodTree) -> Iterator[NDArray[Any]]:
    yield from (getattr(tree, name) for name in ARRAYS if name != "level_offsets")
    yield from (getattr(tree.gaussians, name) for name in FIELDS)


# ---------------------------------------------------------------- writing


class TreeWriter:
    """Writes a tree directory, all or nothing: it takes its name when the block ends well."""

    def __init__(
        self,
        directory: str | os.PathLike[str],
        counts: dict[str, int],
        metadata: TreeMetadata,
    ) -> None:
        self._target = Path(directory)
        self._counts, self._metadata = counts, metadata
        self._files: dict[str, ArrayFile] = {}

    def __enter__(self) -> TreeWriter:
        target = self._target
        if target.exists() and not _replaceable(target):
            raise InputError(f"{target}: must not exist, be empty, or hold a tree ({_DESCRIPTION})")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            self._scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
            self._fresh = self._scratch / "new"
            self._fresh.mkdir()
        except OSError as error:
            raise InputError(f"{target}: cannot be written: {error.strerror}") from error
        return self

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> ArrayFile:
        """A new array, to be filled before ``finish``."""
        self._files[name] = ArrayFile(self._fresh / f"{name}.npy", shape, dtype)
        return self._files[name]

    def put(self, name: str, array: NDArray[Any]) -> None:
        """A whole array."""
        file = self.array(name, array.shape, array.dtype)
        run_chunks(lambda begin, end: file.write(begin, array[begin:end]), len(array))

    def tree(self) -> LodTree:
        """What was written so far, memory-mapped; every array must be there."""
        arrays: dict[str, Any] = {name: file.mapped() for name, file in self._files.items()}
        scene = Scene(*(arrays.pop(name) for name in FIELDS))
        return LodTree(gaussians=scene, metadata=self._metadata, **arrays)

    def finish(self) -> float:
        """Search arrays, checksums, tree.json; returns the seconds of everything that was disk
        work.
        """
        nodes = self._counts["nodes"]
        for name, shape in zip(SEARCH_FILES, search_array_shapes(nodes), strict=True):
            self.array(name, shape, np.float32)
        write_search_arrays(self._files, nodes)
        begin = time.perf_counter()
        seconds = sum(file.seconds for file in self._files.values()) / threads()
        for file in self._files.values():
            file.close()
        with ThreadPoolExecutor(threads()) as pool:
            digests = pool.map(_sha256, (file.path for file in self._files.values()))
            entries = {
                name: {"bytes": file.path.stat().st_size, "sha256": digest}
                for (name, file), digest in zip(self._files.items(), digests, strict=True)
            }
        description: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "counts": self._counts,
            "metadata": dataclasses.asdict(self._metadata),
            "arrays": dict(sorted(entries.items())),
        }
        description["sha256"] = _digest(description)
        text = json.dumps(description, indent=1, allow_nan=False)
        (self._fresh / _DESCRIPTION).write_text(text, encoding="utf-8")
        stamp = (int(time.time()) - _BACKDATED_S) // 2 * 2  # some file systems count in 2 s
        for path in self._fresh.iterdir():
            os.utime(path, (stamp, stamp))
        return seconds + time.perf_counter() - begin

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            for file in self._files.values():
                file.close()
            if kind is None:
                if self._target.exists():
                    self._target.rename(self._scratch / "old")
                self._fresh.rename(self._target)
        except OSError as problem:
            error = problem
            if (self._scratch / "old").exists() and not self._target.exists():
                (self._scratch / "old").rename(self._target)
        finally:
            shutil.rmtree(self._scratch, ignore_errors=True)
        if isinstance(error, OSError):
            raise InputError(f"{self._target}: cannot be written: {error.strerror}") from error


def _replaceable(target: Path) -> bool:
    return target.is_dir() and ((target / _DESCRIPTION).is_file() or not any(target.iterdir()))


# ---------------------------------------------------------------- reading


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
    if description.get("version") not in _READABLE:
        readable = " or ".join(map(str, _READABLE))
        raise InputError(f"{path}: version must be {readable}, not {description.get('version')}")
    if description.get("sha256") != _digest(description):
        raise InputError(f"{path}: checksum must match; the file was altered")
    return description


def _read_array(source: Path, name: str, entry: dict[str, Any], stamp: int | None) -> NDArray[Any]:
    """One array; ``stamp`` is the modification time of an undisturbed file, None trusts none."""
    path = source / f"{name}.npy"
    try:
        status = path.stat()
        if status.st_size != entry["bytes"]:
            raise InputError(f"{path}: must have {entry['bytes']} bytes, not {status.st_size}")
        trusted = status.st_size > _ALWAYS_CHECKED_BYTES and status.st_mtime_ns == stamp
        if not trusted and _sha256(path) != entry["sha256"]:
            raise InputError(f"{path}: checksum must match; the file was altered")
        # copy-on-write rather than read-only: numba compiles read-only arrays separately
        return np.asarray(np.load(path, mmap_mode="c", allow_pickle=False))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
