"""Unit quaternions stored as their three smallest components."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.scene import Float32, normalised_quaternions

_KEPT = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the other three, by omitted index


def join_smallest_three(kept: NDArray[np.float64], omitted: NDArray[np.intp], name: str) -> Float32:
    """[N, 4] unit quaternions from three components each, in whatever order the format has.

    ``omitted`` [N] is the index of the missing component, which is positive and the largest;
    ``kept`` [N, 3] are the others in their order. Raises InputError where they exceed length 1.
    """
    squares = (kept * kept).sum(axis=1)
    if (squares > 1).any():
        bad = int(np.argmax(squares > 1))
        raise InputError(f"{name}: the rotation of Gaussian {bad} must be a unit quaternion")
    quaternions = np.empty((len(kept), 4))
    np.put_along_axis(quaternions, _KEPT[omitted], kept, axis=1)
    np.put_along_axis(quaternions, omitted[:, None], np.sqrt(1.0 - squares)[:, None], axis=1)
    return normalised_quaternions(quaternions, name)


def split_smallest_three(
    quaternions: Float32,
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """The inverse: ``kept`` [N, 3] and ``omitted`` [N] of unit quaternions or their negatives."""
    wide = quaternions.astype(np.float64)
    omitted = np.argmax(np.abs(wide), axis=1)
    largest = np.take_along_axis(wide, omitted[:, None], axis=1)
    wide *= np.where(largest < 0, -1.0, 1.0)
    return np.take_along_axis(wide, _KEPT[omitted], axis=1), omitted
