"""Slots: Gaussians that may merge, their moments, and which two of them merge first. Kernels.

Slots a and b cost ``S(C)^2 (1 + |dc|^2)^2``: C is their merged covariance, S^2 the sum of its
principal 2 x 2 minors, dc the difference of their harmonics of degree 0. A cost is kept as an
integer, its float64 bits with the other slot's number in the last 6: for numbers >= 0 the order is
the same, costs within 1.5e-14 of each other are equal and go by slot, and the least one is found
by vector instructions, its slot with it. Every slot knows its cheapest partner, so that a merge
looks at few of the pairs that did not change.
"""

import numpy as np
from numba import njit

# Moments of a slot, in rows of MOST_SLOTS: first the covariance.
MOST_SLOTS = 64
MOMENTS = 16
MEANS = 13  # first rows, those that are weighted means; the mass is a sum
# unsigned: with signed indices, which might count from the end, nothing is vectorised
ROW = np.uint64(MOST_SLOTS)
XX, XY, XZ, YY, YZ, ZZ = (np.uint64(row * MOST_SLOTS) for row in range(6))
X, Y, Z = (np.uint64(row * MOST_SLOTS) for row in range(6, 9))
RED, GREEN, BLUE = (np.uint64(row * MOST_SLOTS) for row in range(9, 12))
MEAN_OPACITY, MASS = (np.uint64(row * MOST_SLOTS) for row in range(12, 14))
RADIUS, EXTENT = (np.uint64(row * MOST_SLOTS) for row in range(14, 16))  # float32 numbers

COSTS_ROW = np.uint64(MOST_SLOTS + 8)  # columns of a row of costs, some spare
_SLOT = np.int64(MOST_SLOTS - 1)  # bits of a cost that hold a slot
_NEVER = np.int64(0x7FFFFFFFFFFFFF00)  # beyond all costs, with room to add a slot
_AT_A_TIME = np.uint64(8)  # slots: as many as a vector register holds, and none are left over


@njit
def combine(slot, other, moments):  # type: ignore[no-untyped-def]
    """Slot becomes the merge of the two."""
    i, j = np.uint64(slot), np.uint64(other)
    p, xx, xy, xz, yy, yz, zz = _pair(_load(i, moments), _load(j, moments))
    for row in range(6, MEANS):
        k = np.uint64(row) * ROW
        moments[i + k] = p * moments[i + k] + (1.0 - p) * moments[j + k]
    moments[i + XX], moments[i + XY], moments[i + XZ] = xx, xy, xz
    moments[i + YY], moments[i + YZ], moments[i + ZZ] = yy, yz, zz
    moments[i + MASS] += moments[j + MASS]


@njit
def judge(slot, begin, end, moments, costs):  # type: ignore[no-untyped-def]
    """Costs of a slot with the slots begin..end, to its row and their column."""
    row = np.uint64(slot) * COSTS_ROW
    a = _load(np.uint64(slot), moments)
    low = np.uint64(begin)
    for i in range(low, low + _whole(np.uint64(end) - low)):  # up to 7 more: nothing looks at them
        costs[row + i] = _cost(a, _load(i, moments), i)
    for i in range(low, np.uint64(end)):
        costs[i * COSTS_ROW + np.uint64(slot)] = (costs[row + i] & ~_SLOT) | np.int64(slot)
    costs[row + np.uint64(slot)] = _NEVER


@njit
def find_partners(count, costs, partners):  # type: ignore[no-untyped-def]
    """The cheapest partner of each of the slots 0..count, which were all judged."""
    for slot in range(count):
        partners[slot] = _least(slot, count, costs)


@njit
def cheapest(count, partners):  # type: ignore[no-untyped-def]
    """Two slots, the lower one first, that merge next."""
    least, end = _NEVER, np.uint64(count)
    for slot in range(_whole(end)):
        cost = (partners[slot] & ~_SLOT) | np.int64(slot)
        least = min(least, cost if slot < end else _NEVER)
    low = least & _SLOT
    return low, partners[low] & _SLOT


@njit(forceinline=True)  # called, it counts references to its arrays
def replace(low, high, count, moments, costs, partners):  # type: ignore[no-untyped-def]
    """After ``low`` became the merge of low and high: slot count - 1 moves to ``high``, and
    costs and partners of the slots 0..count - 1 follow.
    """
    last, width = count - 1, np.int64(COSTS_ROW)
    if high != last:
        for row in range(MOMENTS):
            k = row * MOST_SLOTS
            moments[k + high] = moments[k + last]
        for slot in range(last):
            costs[high * width + slot] = costs[last * width + slot]
            costs[slot * width + high] = (costs[slot * width + last] & ~_SLOT) | high
        costs[high * width + high] = _NEVER
        partners[high] = partners[last]
    judge(low, 0, last, moments, costs)
    for slot in range(last):
        partner = partners[slot] & _SLOT
        if slot == low or partner in (low, high):
            partners[slot] = _least(slot, last, costs)
        else:
            if partner == last:
                partners[slot] = (partners[slot] & ~_SLOT) | high
            partners[slot] = min(partners[slot], costs[slot * width + low])


@njit
def set_aside(count, numbers, moments, costs, kept_numbers, kept_moments, place):  # type: ignore[no-untyped-def]
    """The slots 0..count with the ``numbers`` of their nodes to row ``place`` of the kept."""
    kept_numbers[place, 0] = count
    for slot in range(count):
        kept_numbers[place, 1 + slot] = numbers[slot]
        row, rest = slot * np.int64(COSTS_ROW), 1 + count + slot * count
        for other in range(count):
            kept_numbers[place, rest + other] = costs[row + other]
        for row in range(MOMENTS):
            kept_moments[place, slot * MOMENTS + row] = moments[row * MOST_SLOTS + slot]


@njit
def restore(kept_numbers, kept_moments, place, at, numbers, moments, costs):  # type: ignore[no-untyped-def]
    """What was set aside becomes the slots from ``at`` on; returns how many there are then."""
    count = kept_numbers[place, 0]
    for slot in range(count):
        numbers[at + slot] = kept_numbers[place, 1 + slot]
        row, rest = (at + slot) * np.int64(COSTS_ROW) + at, 1 + count + slot * count
        for other in range(count):
            costs[row + other] = kept_numbers[place, rest + other] + at
        costs[row + slot] = _NEVER
        for row in range(MOMENTS):
            moments[row * MOST_SLOTS + at + slot] = kept_moments[place, slot * MOMENTS + row]
    return at + count


@njit
def _least(slot, count, costs):  # type: ignore[no-untyped-def]
    row, end = np.uint64(slot) * COSTS_ROW, np.uint64(count)
    least = _NEVER
    for i in range(_whole(end)):
        least = min(least, costs[row + i] if i < end else _NEVER)
    return least


@njit
def _whole(count):  # type: ignore[no-untyped-def]
    """At least so many slots, in whole registers."""
    return (count + _AT_A_TIME - np.uint64(1)) // _AT_A_TIME * _AT_A_TIME


@njit
def _cost(a, b, slot):  # type: ignore[no-untyped-def]
    """Of merging two loaded slots, with the number of one of them."""
    _, xx, xy, xz, yy, yz, zz = _pair(a, b)
    red, green, blue = a[3][0] - b[3][0], a[3][1] - b[3][1], a[3][2] - b[3][2]
    unlike = 1.0 + (red * red + green * green + blue * blue)
    minors = (xx * yy - xy * xy) + (xx * zz - xz * xz) + (yy * zz - yz * yz)
    cost = max(minors, 0.0) * (unlike * unlike)  # rounding leaves lines a little below zero
    return (np.float64(cost).view(np.int64) & ~_SLOT) | np.int64(slot)


@njit
def _load(i, moments):  # type: ignore[no-untyped-def]
    """Covariance, mean, colour and mass of a slot (unsigned)."""
    return (
        (moments[i + XX], moments[i + XY], moments[i + XZ]),
        (moments[i + YY], moments[i + YZ], moments[i + ZZ]),
        (moments[i + X], moments[i + Y], moments[i + Z]),
        (moments[i + RED], moments[i + GREEN], moments[i + BLUE]),
        moments[i + MASS],
    )


@njit
def _pair(a, b):  # type: ignore[no-untyped-def]
    """Share of slot a in the merge of two loaded slots, and the merge's covariance."""
    total = a[4] + b[4]
    p = a[4] / total if total > 0.0 else 0.5
    q = 1.0 - p
    r = p * q
    dx, dy, dz = a[2][0] - b[2][0], a[2][1] - b[2][1], a[2][2] - b[2][2]
    return (
        p,
        p * a[0][0] + q * b[0][0] + r * dx * dx,
        p * a[0][1] + q * b[0][1] + r * dx * dy,
        p * a[0][2] + q * b[0][2] + r * dx * dz,
        p * a[1][0] + q * b[1][0] + r * dy * dy,
        p * a[1][1] + q * b[1][1] + r * dy * dz,
        p * a[1][2] + q * b[1][2] + r * dz * dz,
    )
