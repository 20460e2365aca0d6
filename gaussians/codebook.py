"""Vector quantisation of the spherical harmonics above degree 0 (Sec. 4.3; residual stages)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController, threadpool_limits

from gaussians.errors import InputError
from gaussians.parallel import run_chunks

UInt16 = NDArray[np.uint16]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLOAT32_STEP = 2.0**-24  # largest relative rounding error of float32
_MOST_WORDS = 65536
AC_RANGE = 8.0  # coefficients beyond this are not coded by a codebook
AC_ERROR = 1.0  # nor is a Gaussian of which one coefficient would be off by more than this
_GRID = 2.0**14  # words and vectors are compared on multiples of 1 / _GRID
_BATCH = 4096
_BLOCK = 1 << 19  # distances held at a time


@dataclass(frozen=True)
class Codebook:
    """Vector quantiser of the spherical-harmonic coefficients above degree 0, in residual stages.

    Stage s codes what the stages before it left over. Words are float16 multiples of 2^-14 within
    +-16, vectors are rounded to multiples of 2^-14 before they are compared with them: squared
    distances are then exact in float64 whatever the order of summation, so neither training nor
    ``encode`` depends on the linear-algebra library, its threads, or the machine.
    """

    stages: tuple[NDArray[np.float16], ...]  # each [words, dimensions]

    @classmethod
    def train(cls, vectors: Float32, *, words: int, stages: int, seed: int) -> Codebook:
        """Mini-batch k-means, one pass in random order over ``vectors`` [N, dimensions] per stage.

        At most N / 8 words, duplicates removed. Vectors with a coefficient beyond ``AC_RANGE``
        are left out. Raises InputError unless words and stages are positive and any vector is
        left.
        """
        if words < 1 or words > _MOST_WORDS or stages < 1:
            raise InputError(
                f"codebook needs 1..65536 words and >= 1 stages, not {words}, {stages}"
            )
        rest = _on_grid(vectors[(np.abs(vectors) <= AC_RANGE).all(axis=1)])
        if not len(rest):
            raise InputError(f"codebook needs a vector with all coefficients within {AC_RANGE:g}")
        books = []
        for stage in range(stages):
            count = max(1, min(words, len(rest) // 8))
            book = _train_stage(rest, count, np.random.default_rng([seed, stage]))
            rest = rest - book[_nearest(rest, book)]
            books.append(book)
        return cls(tuple(books))

    @property
    def dimensions(self) -> int:
        """Coefficients per vector."""
        return self.stages[0].shape[1]

    @property
    def index_type(self) -> type[np.unsignedinteger]:
        """The narrowest type that numbers the words of every stage."""
        return np.uint8 if max(len(book) for book in self.stages) <= 256 else np.uint16

    @property
    def size_bytes(self) -> int:
        """Bytes of all words."""
        return sum(book.nbytes for book in self.stages)

    def encode(self, vectors: Float32) -> tuple[UInt16, Mask]:
        """Nearest words [N, stages], and per row whether no coefficient is off by more than
        ``AC_ERROR``.
        """
        valid: Mask = np.all(np.abs(vectors) <= AC_RANGE, axis=1)
        rest = _on_grid(np.where(valid[:, None], vectors, 0.0))
        codes = np.empty((len(vectors), len(self.stages)), np.uint16)
        for stage, book in enumerate(self.stages):
            codes[:, stage] = _nearest(rest, book)
            rest -= book[codes[:, stage]]
        errors = np.abs(self.decode(codes).astype(np.float64) - vectors)
        return codes, valid & np.all(errors <= AC_ERROR, axis=1)

    def decode(self, codes: UInt16) -> Float32:
        """Sums of words [N, dimensions]; exact in float32."""
        total = self.stages[0][codes[:, 0]].astype(np.float32)
        for stage, book in enumerate(self.stages[1:], start=1):
            total += book[codes[:, stage]]
        return total


def _on_grid(vectors: NDArray[np.floating]) -> Float64:
    return np.rint(np.asarray(vectors, np.float64) * _GRID) / _GRID


def _train_stage(vectors: Float64, words: int, rng: np.random.Generator) -> NDArray[np.float16]:
    """Words of one stage: scikit-learn's mini-batch steps, rounded to the grid after each."""
    from sklearn.cluster import MiniBatchKMeans

    order = rng.permutation(len(vectors))
    start = vectors[order[:words]]
    means = MiniBatchKMeans(
        words, init=start, n_init=1, compute_labels=False, random_state=int(rng.integers(2**31))
    )
    batch = max(_BATCH, words)
    with threadpool_limits(1):  # several threads wait for each other longer than they work
        for begin in range(0, len(order), batch):
            rows = order[begin : begin + batch]
            if len(rows) < words:
                break
            means.partial_fit(vectors[rows])
            means.cluster_centers_[:] = _on_grid(means.cluster_centers_)
    return np.unique(means.cluster_centers_.astype(np.float16), axis=0)


class _Search(NamedTuple):
    """A book as it is searched."""

    book: Float64  # [words, dimensions]
    norms: Float64  # [words] squared lengths
    narrow: Float32  # [dimensions + 1, words] what a row and a 1 are multiplied with
    longest: float

    @classmethod
    def of(cls, book: NDArray[np.float16]) -> _Search:
        wide = book.astype(np.float64)
        norms = (wide * wide).sum(axis=1)
        narrow = np.vstack([-2 * wide.T, norms]).astype(np.float32)
        return cls(wide, norms, narrow, math.sqrt(norms.max()))


def _nearest(vectors: Float64, book: NDArray[np.float16]) -> NDArray[np.int64]:
    """[N] index of the nearest word; the lower one of two at the same distance."""
    best = np.empty(len(vectors), np.int64)
    with _linear_algebra().limit(limits=1):
        run_chunks(_nearest_range, len(vectors), vectors, _Search.of(book), best)
    return best


@cache
def _linear_algebra() -> ThreadpoolController:
    """Looking for the library takes milliseconds."""
    return ThreadpoolController()


def _nearest_range(begin: int, end: int, vectors: Float64, search: _Search, best: Any) -> None:
    """Distances in float32 first; rows whose two best differ by less than the rounding bound of a
    dot product in any order are decided by exact distances in float64.
    """
    book, norms, narrow, longest = search
    block = max(1, _BLOCK // len(book))
    for low in range(begin, end, block):
        rows = vectors[low : min(low + block, end)]
        lengths = np.sqrt((rows * rows).sum(axis=1))
        bounds = (book.shape[1] + 4) * FLOAT32_STEP * (2 * lengths * longest + longest**2)
        wide = np.ones((len(rows), book.shape[1] + 1), np.float32)
        wide[:, :-1] = rows
        distances = wide @ narrow
        numbers = np.arange(len(rows))
        first = distances.argmin(axis=1)
        least = distances[numbers, first].astype(np.float64)
        distances[numbers, first] = np.inf
        close = np.flatnonzero(distances.min(axis=1) - least <= 2 * bounds)
        if len(close):
            first[close] = (norms - 2 * (rows[close] @ book.T)).argmin(axis=1)
        best[low : low + len(rows)] = first
