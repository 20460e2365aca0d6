"""Kernels of the timing wheel; `lod_cloud.search.wheel` says what they do together.

**When a decision can change.** A node was found (not) refined at camera c0, distance D from its
centre, with threshold t. In float32 the test compares D^2 with an error of at most 5 roundings
and t^2 with one, so ``|D - t| > t 2^-22`` suffices for the test to agree with real numbers; we
allow twice that (``_SLACK``). Let v be the way from c0 to a later camera.

* *Not refined* (D > t): the new distance is at least ``D - w.v``, where w points from c0 to the
  node. Nothing changes before w.v reaches ``D - t``.
* *Refined* (D < t): the new distance squared is ``D^2 + 2 D w.v + |v|^2``, w pointing away.

The hand of a sector (see `lod_cloud.search.sectors`) is a running bound on w.v for all w of that
sector. Hands of the second kind advance by ``max(reach + KAPPA, KAPPA) |step|``: when such a hand
has advanced by x, the path P is at most x / KAPPA and w.v at most x - KAPPA P. The distance squared
is then at most ``D^2 + 2 D (x - KAPPA P) + P^2``, convex in P and so largest at P = 0 or at
P = x / KAPPA. So nothing changes before x = min((t^2 - D^2) / 2 D, KAPPA sqrt(t^2 - D^2)); nor
before P = t - D: one more hand advances by the length of the path. An entry goes to that of the
two hands which will take longer if the camera goes on as it did last.

**Buckets.** A hand at K pops every entry of key <= K. Near keys go to fine buckets, far ones to
coarse buckets popped when the hand enters them. Both are rings: what lies more than one turn ahead
is popped early, which only costs a test. Decisions within the slack are popped at every search.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lod_cloud.search.marks import ONE, any_set, clear_bit, is_set, set_bit, stays_refined
from lod_cloud.search.prefetching import prefetch
from lod_cloud.search.search_tree import CHILD_COUNT, FIRST_CHILD, PARENT
from lod_cloud.search.sectors import SECTORS, reach, sector_of

KAPPA = 0.2
FINE_M, FINE = 2.0**-7, 8  # width and number of fine buckets of a hand: one coarse bucket
COARSE_M, COARSE = 2.0**-4, 512
RING = FINE + COARSE
HANDS = 2 * SECTORS + 1  # hand 2 j + kind belongs to sector j; the last one moves with the path
BUCKETS = HANDS * RING + 1  # the last one is popped at every search
PER_CHUNK = 15  # node ids in a chunk of 64 bytes; its first number is the next chunk
FREE, USED = 0, 1  # places in ``counts``: first free chunk, chunks ever used
_SLACK = 2.0**-21
_TINY = 1e-15  # metres; squares of less may vanish in float32
_BATCH = 256
_AHEAD, _NEAR = 24, 12  # nodes whose record, and whose neighbours' marks, are asked for in advance


@njit
def _bucket(hands, rates, refined, dx, dy, dz, t):  # type: ignore[no-untyped-def]
    """Bucket of a node seen from (dx, dy, dz) away (camera minus centre), threshold t."""
    d2 = dx * dx + dy * dy + dz * dz
    d = np.sqrt(d2)
    slack = t * _SLACK + _TINY
    margin = (t - d if refined else d - t) - slack
    if margin <= 0.0 or d == 0.0:
        return BUCKETS - 1
    if refined:
        inner = t - slack
        room = inner * inner - d2
        straight = min(room / (2.0 * d), KAPPA * np.sqrt(room))
        hand = 2 * sector_of(dx, dy, dz) + 1
        if straight > margin * rates[hand]:
            margin = straight
        else:
            hand = HANDS - 1
    else:
        hand = 2 * sector_of(-dx, -dy, -dz)
    now = hands[hand]
    # the differences above and the sum below are good to 1e-15 of the larger number
    farthest = now + 2.0 * COARSE * COARSE_M
    key = min(now + margin * (1.0 - 1e-9) - abs(now) * 1e-15, farthest)
    if key <= now:
        return BUCKETS - 1
    fine = int(np.floor(key * (1.0 / FINE_M)))
    if fine - int(np.floor(now * (1.0 / FINE_M))) < FINE:
        return hand * RING + (fine & (FINE - 1))
    here = int(np.floor(now * (1.0 / COARSE_M)))
    coarse = min(int(np.floor(key * (1.0 / COARSE_M))), here + COARSE - 1)
    return hand * RING + FINE + (coarse & (COARSE - 1))


@njit
def _test(node, cx, cy, cz, floats, k, grow, was):  # type: ignore[no-untyped-def]
    return stays_refined(
        cx, cy, cz, floats[node, 0], floats[node, 1], floats[node, 2],
        floats[node, 3], floats[node, 4], k, grow, was,
    )  # fmt: skip


@njit
def _is_active(node, ints, refined):  # type: ignore[no-untyped-def]
    """Whether the decision on a node can be the next to change: a cut node, or a refined node
    without refined child.
    """
    if is_set(refined, node):
        return not any_set(refined, ints[node, FIRST_CHILD], ints[node, CHILD_COUNT])
    return ints[node, PARENT] < 0 or is_set(refined, ints[node, PARENT])


@njit
def _longer(array, least):  # type: ignore[no-untyped-def]
    larger = np.empty(2 * len(array) + least, np.int32)
    for i in range(len(array)):
        larger[i] = array[i]
    return larger


@njit(cache=True, error_model="numpy", nogil=True)
def collect(step, hands, rates, heads, fill, counts, chunks, axes, cosines, sines):  # type: ignore[no-untyped-def]
    """Move the hands by a step and return the nodes whose entries are due.

    Their entries are gone, their ``scheduled`` marks stay.
    """
    taken = np.empty(1024, np.int32)  # first chunks of buckets
    held = np.empty(1024, np.int32)  # ids in each
    length = np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    count = 0
    for hand in range(-1, HANDS if length > 0.0 else 0):
        first = fine_end = last = 0
        if hand >= 0:
            advance = 1.0
            if hand < HANDS - 1:
                j = hand >> 1
                along = axes[j, 0] * step[0] + axes[j, 1] * step[1] + axes[j, 2] * step[2]
                advance = reach(along / length, cosines[j], sines[j])
                if hand & 1:
                    advance = max(advance + KAPPA, KAPPA)
            rates[hand] = advance
            before = hands[hand]
            now = before + (advance + 1e-12) * length
            now += (abs(now) + abs(before)) * 2.3e-16
            hands[hand] = now
            if now <= before:
                continue
            if hand + 4 < HANDS:
                later = int(np.floor(hands[hand + 4] * (1.0 / FINE_M)))
                prefetch(heads, np.intp((hand + 4) * RING + (later & (FINE - 1))))
            first = int(np.floor(before * (1.0 / FINE_M)))
            last = int(np.floor(now * (1.0 / FINE_M)))
            fine_end = min(last, first + FINE - 1) + 1 - first
            coarse = int(np.floor(before * (1.0 / COARSE_M))) + 1
            last = int(np.floor(now * (1.0 / COARSE_M)))
            last = fine_end + max(0, min(last, coarse + COARSE - 1) + 1 - coarse)
        else:
            last = 1
        if count + last > len(taken):
            taken, held = _longer(taken, last), _longer(held, last)
        for i in range(last):
            if hand < 0:
                bucket = BUCKETS - 1
            elif i < fine_end:
                bucket = hand * RING + ((first + i) & (FINE - 1))
            else:
                bucket = hand * RING + FINE + ((coarse + i - fine_end) & (COARSE - 1))
            head = heads[bucket]
            if head >= 0:
                prefetch(chunks, np.intp(head) * (PER_CHUNK + 1))
                taken[count] = head
                held[count] = fill[bucket]
                heads[bucket] = -1
                count += 1
    return _release(counts, chunks, taken[:count], held)


@njit
def _release(counts, chunks, firsts, numbers):  # type: ignore[no-untyped-def]
    """The node ids in the noted buckets; their chunks become free."""
    due = np.empty(PER_CHUNK * (len(firsts) + 64), np.int32)
    found = 0
    for i in range(len(firsts)):
        chunk, held = firsts[i], numbers[i]
        while chunk >= 0:
            if found + PER_CHUNK > len(due):
                due = _longer(due, PER_CHUNK)
            for j in range(1, held + 1):
                due[found] = chunks[chunk, j]
                found += 1
            below = chunks[chunk, 0]
            chunks[chunk, 0] = counts[FREE]
            counts[FREE] = chunk
            chunk = below
            held = np.int32(PER_CHUNK)
    return due[:found]


@njit(cache=True, error_model="numpy", nogil=True)
def insert(nodes, cx, cy, cz, k, grow, floats, refined, hands, rates, heads, fill, counts, chunks):  # type: ignore[no-untyped-def]
    """Make an entry for each node, whose decision is known. There must be chunks enough for all.

    In batches: the buckets of all of a batch are found first, so that they can be asked for.
    """
    buckets = np.empty(_BATCH, np.int32)
    for begin in range(0, len(nodes), _BATCH):
        count = min(_BATCH, len(nodes) - begin)
        for i in range(count):
            if begin + i + _AHEAD < len(nodes):
                prefetch(floats, np.intp(nodes[begin + i + _AHEAD]) * 8)
            node = nodes[begin + i]
            was = is_set(refined, node)
            scale = grow if was else ONE
            t = scale * floats[node, 3] + (scale * k) * floats[node, 4]
            dx = np.float64(cx) - np.float64(floats[node, 0])
            dy = np.float64(cy) - np.float64(floats[node, 1])
            dz = np.float64(cz) - np.float64(floats[node, 2])
            buckets[i] = _bucket(hands, rates, was, dx, dy, dz, np.float64(t))
            prefetch(heads, np.intp(buckets[i]))
            prefetch(fill, np.intp(buckets[i]))
        for i in range(count):
            if i + _NEAR < count:
                later = max(heads[buckets[i + _NEAR]], 0)
                prefetch(chunks, np.intp(later) * (PER_CHUNK + 1))
            bucket = buckets[i]
            head = heads[bucket]
            if head < 0 or fill[bucket] == PER_CHUNK:
                fresh = counts[FREE]
                if fresh >= 0:
                    counts[FREE] = chunks[fresh, 0]
                else:
                    fresh = counts[USED]
                    counts[USED] += 1
                chunks[fresh, 0] = head
                heads[bucket] = fresh
                fill[bucket] = 0
                head = fresh
            fill[bucket] += 1
            chunks[head, fill[bucket]] = nodes[begin + i]


@njit(cache=True, error_model="numpy", nogil=True)
def process(due, cx, cy, cz, k, grow, floats, ints, refined, scheduled, budget):  # type: ignore[no-untyped-def]
    """Test the nodes that are due and everything that follows from those that change.

    Returns expanded, collapsed (in no order), nodes to insert, and nodes tested. Stops, with
    nothing in order but the two lists, once more than ``budget`` nodes have been tested.
    """
    opened_nodes = np.empty(512, np.int32)
    closed_nodes = np.empty(512, np.int32)
    waiting = np.empty(len(due) + 1024, np.int32)
    opened = closed = tested = made = 0
    for i in range(len(due)):
        if i + _AHEAD < len(due):
            prefetch(floats, np.intp(due[i + _AHEAD]) * 8)
            prefetch(scheduled, np.intp(due[i + _AHEAD]) >> 3)
            prefetch(refined, np.intp(due[i + _AHEAD]) >> 3)
        if i + _NEAR < len(due):
            later = due[i + _NEAR]
            above, below = max(ints[later, PARENT], 0), ints[later, FIRST_CHILD]
            prefetch(refined, np.intp(above >> 3))
            prefetch(refined, np.intp(below >> 3))
            prefetch(scheduled, np.intp(below >> 3))
            prefetch(floats, np.intp(above if is_set(refined, later) else below) * 8)
        node = due[i]
        clear_bit(scheduled, node)
        if not _is_active(node, ints, refined):
            continue
        tested += 1
        was = is_set(refined, node)
        now = _test(node, cx, cy, cz, floats, k, grow, was)
        if made + 2 > len(waiting):
            waiting = _longer(waiting, 2)
        if now == was:
            set_bit(scheduled, node)
            waiting[made] = node
            made += 1
            continue
        if tested > budget:
            break
        if was:  # collapse, and upwards as far as it goes
            while True:
                clear_bit(refined, node)
                if closed == len(closed_nodes):
                    closed_nodes = _longer(closed_nodes, 1)
                closed_nodes[closed] = node
                closed += 1
                if made + 2 > len(waiting):
                    waiting = _longer(waiting, 2)
                set_bit(scheduled, node)
                waiting[made] = node
                made += 1
                node = ints[node, PARENT]
                if node < 0 or is_set(scheduled, node) or any_set(
                    refined, ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
                ):  # fmt: skip
                    break
                tested += 1
                if _test(node, cx, cy, cz, floats, k, grow, True):
                    set_bit(scheduled, node)
                    waiting[made] = node
                    made += 1
                    break
            continue
        # expand, and downwards as far as it goes; opened_nodes from ``at`` on are still to be
        at = opened
        set_bit(refined, node)
        if opened == len(opened_nodes):
            opened_nodes = _longer(opened_nodes, 1)
        opened_nodes[opened] = node
        opened += 1
        while at < opened and tested <= budget:
            node = opened_nodes[at]
            at += 1
            first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
            if made + count + 1 > len(waiting):
                waiting = _longer(waiting, count + 1)
            if opened + count > len(opened_nodes):
                opened_nodes = _longer(opened_nodes, count)
            any_refined = False
            for child in range(first, first + count):
                if ints[child, CHILD_COUNT] == 0 or is_set(scheduled, child):
                    continue
                tested += 1
                if _test(child, cx, cy, cz, floats, k, grow, False):
                    any_refined = True
                    set_bit(refined, child)
                    opened_nodes[opened] = child
                    opened += 1
                else:
                    set_bit(scheduled, child)
                    waiting[made] = child
                    made += 1
            if not any_refined:
                set_bit(scheduled, node)
                waiting[made] = node
                made += 1
    return (
        opened_nodes[:opened].copy(),
        closed_nodes[:closed].copy(),
        waiting[:made],
        tested,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def active_nodes(begin, most, ints, refined, scheduled):  # type: ignore[no-untyped-def]
    """Active nodes without entry among refined nodes, from node ``begin`` on, and
    their children, until ``most`` were found; and where to go on. Marks them as scheduled.
    """
    waiting = np.empty(1024, np.int32)
    made = 0
    node = begin
    if not is_set(refined, 0):
        node = len(ints)
        if ints[0, CHILD_COUNT] and not is_set(scheduled, 0):
            set_bit(scheduled, 0)
            waiting[made] = 0
            made = 1
    while node < len(ints) and made < most:
        if node & 7 == 0 and refined[node >> 3] == 0:
            node += 8
            continue
        if is_set(refined, node):
            any_refined = False
            first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
            if made + count + 1 > len(waiting):
                waiting = _longer(waiting, count + 1)
            for child in range(first, first + count):
                if is_set(refined, child):
                    any_refined = True
                elif ints[child, CHILD_COUNT] and not is_set(scheduled, child):
                    set_bit(scheduled, child)
                    waiting[made] = child
                    made += 1
            if not any_refined and not is_set(scheduled, node):
                set_bit(scheduled, node)
                waiting[made] = node
                made += 1
        node += 1
    return waiting[:made], min(node, len(ints))


@njit(cache=True, error_model="numpy", nogil=True)
def active_among(nodes, ints, refined, scheduled):  # type: ignore[no-untyped-def]
    """Those of the nodes, of their parents and of their children that are active and have no
    entry. Marks them as scheduled.
    """
    waiting = np.empty(1024, np.int32)
    made = 0
    for node in nodes:
        first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
        if made + count + 2 > len(waiting):
            waiting = _longer(waiting, count + 2)
        for i in range(-2, count):
            near = first + i
            if i < 0:
                near = node if i == -1 else ints[node, PARENT]
            if (
                near >= 0
                and ints[near, CHILD_COUNT]
                and not is_set(scheduled, near)
                and _is_active(near, ints, refined)
            ):
                set_bit(scheduled, near)
                waiting[made] = near
                made += 1
    return waiting[:made]


@njit(cache=True, error_model="numpy", nogil=True)
def set_marks(nodes, marks, value):  # type: ignore[no-untyped-def]
    """Set (or clear) the marks of nodes."""
    for node in nodes:
        if value:
            set_bit(marks, node)
        else:
            clear_bit(marks, node)
