"""Small work traces built by hand, and configurations with one number changed."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from arch import ClientWork
from gaussians.work import EyeWork, FrameWork, FrontEndWork, Int32, StereoWork

T = TypeVar("T")


def changed(config: T, path: str, value: Any) -> T:
    """``config`` with the field at a dotted path replaced."""
    name, _, rest = path.partition(".")
    if rest:
        value = changed(getattr(config, name), rest, value)
    return dataclasses.replace(config, **{name: value})  # type: ignore[type-var] # a dataclass


def eye(entries: ArrayLike, processed: ArrayLike | None = None) -> EyeWork:
    """Lists of these lengths [tiles_y, tiles_x]; 16 checks, 8 passes, 7 blends per entry walked."""
    lengths = np.asarray(entries, np.int32)
    done = lengths if processed is None else np.asarray(processed, np.int32)
    stopped = (done < lengths).astype(np.int32)
    return EyeWork(lengths, done, 16 * done, 8 * done, 7 * done, stopped)


def frame(
    left: EyeWork,
    right: EyeWork,
    fifo: ArrayLike | None = None,
    forward_only: ArrayLike | None = None,
    *,
    splats: int = 10,
    rows: int | None = None,
    sh_degree: int = 3,
    right_projected: bool = True,
    independent_right_tiles: int = 0,
) -> FrameWork:
    """A frame of 4x4 px tiles; stereo when ``fifo`` [rows, tiles_y, tiles_x] is given."""
    tiles_y, tiles_x = left.entries.shape
    zero = np.zeros((tiles_y, tiles_x), np.int32)
    stereo = fifo is not None
    pairs = int(left.entries.sum()), int(right.entries.sum())
    front = FrontEndWork(splats, 0, 0, 0, 0, splats, splats, rows or max(pairs), *pairs)
    work = StereoWork(
        fifo_entries=np.asarray(fifo, np.int32) if stereo else np.zeros((4, *zero.shape), np.int32),
        forward_only=zero if forward_only is None else np.asarray(forward_only, np.int32),
        walked_after_termination=left.entries - left.processed if stereo else zero,
        dropped=0,
        spilled=0,
        unseen=0,
        duplicates=0,
    )
    own = independent_right_tiles if stereo else tiles_y * tiles_x
    return FrameWork(
        4 * tiles_x, 4 * tiles_y, 4, sh_degree, "exact: hand-made" if stereo else "independent",
        stereo, right_projected, front, left, right, work, own,
    )  # fmt: skip


def client(splats: int = 10, **counts: int) -> ClientWork:
    """A client that holds and selects ``splats`` and received nothing, unless told."""
    defaults = dict.fromkeys((f.name for f in dataclasses.fields(ClientWork)), 0)
    return ClientWork(**{**defaults, "held_splats": splats, "selected_splats": splats, **counts})


def random_frame(
    rng: np.random.Generator, tiles_y: int, tiles_x: int, mean: int, *, stereo: bool = True
) -> FrameWork:
    """Random lists; with ``stereo`` every right entry is forwarded by one of four rows."""

    def random_eye() -> EyeWork:
        entries = rng.poisson(mean, (tiles_y, tiles_x)).astype(np.int32)
        return eye(entries, np.minimum(entries, rng.poisson(mean, entries.shape)))

    left, right = random_eye(), random_eye()
    if not stereo:
        return frame(left, right, splats=4 * mean * tiles_y, rows=mean * tiles_y * tiles_x)
    fifo: Int32 = np.zeros((4, tiles_y, tiles_x), np.int32)
    rest = right.entries.copy()
    for k in range(3):
        fifo[k] = rng.binomial(rest, 0.6)
        rest = rest - fifo[k]
    fifo[3] = rest
    forward_only = rng.binomial(left.entries, 0.06).astype(np.int32)
    rows = max(1, int(left.entries.sum()) // 4)
    return frame(left, right, fifo, forward_only, splats=4 * mean * tiles_y, rows=rows)
