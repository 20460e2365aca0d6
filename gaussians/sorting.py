"""Depth order: (bits of float32 depth, id), the one total order of the project."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

_DIGIT_BITS = 11
_BUCKETS = 1 << _DIGIT_BITS


@njit(cache=True, error_model="numpy")
def _radix_sort(keys: NDArray[np.uint32], order: NDArray[np.int32]) -> NDArray[np.int32]:
    """Stable least-significant-digit radix sort of uint32 keys; permutes order alike."""
    count = keys.shape[0]
    other_keys = np.empty_like(keys)
    other_order = np.empty_like(order)
    for shift in range(0, 33, _DIGIT_BITS):
        start = np.zeros(_BUCKETS + 1, np.int64)
        for i in range(count):
            start[((keys[i] >> shift) & (_BUCKETS - 1)) + 1] += 1
        for b in range(_BUCKETS):
            start[b + 1] += start[b]
        for i in range(count):
            digit = (keys[i] >> shift) & (_BUCKETS - 1)
            target = start[digit]
            start[digit] = target + 1
            other_keys[target] = keys[i]
            other_order[target] = order[i]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


def depth_order(depths: NDArray[np.float32], ids: NDArray[np.int32]) -> NDArray[np.int32]:
    """The ids sorted by (bits of depth, id).

    Parameters
    ----------
    depths : [M] float32, all >= 0
    ids : [M] int32, ascending; the stable sort then breaks ties by id
    """
    return _radix_sort(depths.view(np.uint32).copy(), ids.copy())
