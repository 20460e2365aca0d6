"""The buckets of the timing wheel: when an entry is due, and where it waits until then.

**When a decision can change.** A node was found (not) refined at camera c0, distance D from its
centre, with threshold t. In float32 the test compares D^2 with an error of at most 5 roundings
and t^2 with one, so ``|D - t| > t 2^-22`` suffices for the test to agree with real numbers. The
margin ``|D - t|``, computed in float32 too, is less certain by ``(3.5 D + |D - t|) 2^-24``; we
subtract ``(D + t) 2^-21`` (``_SLACK``), more than both. Let v be the way from c0 to a later camera.

* *Not refined* (D > t): the new distance is at least ``D - w.v``, where w points from c0 to the
  node. Nothing changes before w.v reaches ``D - t``.
* *Refined* (D < t): the new distance squared is ``D^2 + 2 D w.v + |v|^2``, w pointing away.

The hand of a sector (see `lod_cloud.search.sectors`) is a running bound on w.v for all w of that
sector. Hands of the second kind advance by ``max(reach + KAPPA, MU) |step|``: when such a hand
has advanced by x, the path P is at most x / MU and w.v at most x - KAPPA P. The distance squared
is then at most ``D^2 + 2 D (x - KAPPA P) + P^2``, convex in P and so largest at P = 0 or at
P = x / MU. So nothing changes before x is the smaller of ``(t^2 - D^2) / 2 D`` and, with
g = KAPPA - MU, ``MU (g D + sqrt(g^2 D^2 + t^2 - D^2))``; nor before P = t - D: one more hand
advances by the length of the path. An entry goes to that of the two hands which will take longer
if the camera goes on as it did last.

**Buckets.** A hand at K pops every entry of key <= K. Near keys go to fine buckets, far ones to
coarse buckets popped when the hand enters them. Both are rings: what lies more than one turn ahead
is popped early, which only costs a test. Decisions within the slack are popped at every search.
A bucket is a list of chunks of 15 ids; ``heads`` holds 16 times the first chunk plus the ids in
it (the others are full), or -1.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.lanes import prefetch
from lod_cloud.search.marks import ONE
from lod_cloud.search.prefetching import BATCH, gather
from lod_cloud.search.sectors import SECTORS, reach, sector_of

KAPPA, MU = 0.1, 0.05
HANDS = 2 * SECTORS + 1  # hand 2 j + kind belongs to sector j; the last one moves with the path
FINE_M, FINE = 2.0**-7, 8  # width and number of fine buckets of a hand: one coarse bucket
COARSE_M, COARSE = 2.0**-4, 512
# Hands start apart: where many advance alike they enter coarse buckets one by one, not all at once.
START_M = COARSE_M * np.modf(np.arange(HANDS) * 0.6180339887498949)[0]
FINE_BITS = 3  # FINE = 2^3
COARSE_BEGIN = HANDS * FINE  # fine buckets stand together: they fit into the nearest cache
BUCKETS = HANDS * (FINE + COARSE) + 1  # the last one is popped at every search
PER_CHUNK = 15  # node ids in a chunk of 64 bytes; its first number is the next chunk
FREE, USED, ENTRIES = 0, 1, 2  # in ``counts``: first free chunk, chunks ever used, entries
_SLACK = np.float32(2.0**-21)
_TINY = np.float32(1e-15)  # metres; squares of less may vanish in float32
_ZERO, _LITTLE, _LEAST = np.float32(0), np.float32(1e-3), np.float32(1e-30)
_MU, _GAIN = np.float32(MU), np.float32(KAPPA - MU)
_NEAR = 12  # nodes whose chunk is asked for in advance
_HANDS_AHEAD = 12  # likewise hands, whose coarse bucket is


@njit(cache=True)
def chunks_for(entries):  # type: ignore[no-untyped-def]
    """Chunks that hold so many entries, wherever they are: one of a bucket is not full."""
    return min(BUCKETS, entries) + entries // PER_CHUNK


@njit(forceinline=True)
def find_keys(held, cx, cy, cz, k, grow, rows, was, margins, ways, sectors):  # type: ignore[no-untyped-def]
    """For a batch of nodes: how far to go before the decision can change, in any direction
    (``margins``) and by the hand of a sector (``ways``), and which hand that is.

    In float32 and without branches: a compiler makes vector instructions of it.
    """
    for i in range(held):
        scale = grow if was[i] else ONE
        t = scale * rows[3, i] + (scale * k) * rows[4, i]
        dx, dy, dz = cx - rows[0, i], cy - rows[1, i], cz - rows[2, i]
        d = np.sqrt((dx * dx + dy * dy) + dz * dz)
        margin = (t - d if was[i] else d - t) - ((t + d) * _SLACK + _TINY)
        room = max(margin * (margin + (d + d)), _ZERO)  # t^2 - D^2
        bent = d * _GAIN
        straight = min(
            room / max(d + d, margin * _LITTLE, _LEAST),
            _MU * (bent + np.sqrt(bent * bent + room)),
        )
        margins[i] = margin
        ways[i] = straight if was[i] else margin
        sign = ONE if was[i] else -ONE
        sectors[i] = np.int32(2) * sector_of(sign * dx, sign * dy, sign * dz) + np.int32(was[i])


@njit(forceinline=True)
def _bucket(margin, way, sector, hands, rates):  # type: ignore[no-untyped-def]
    """Where an entry waits: in a bucket of the hand that will take longer."""
    hand, far = np.intp(sector), np.float64(way)
    if far < margin * rates[hand]:
        hand, far = HANDS - 1, np.float64(margin)
    now = hands[hand] * (1.0 / FINE_M)
    # the way is at most 9 roundings of float32 too long; the sum is good to 1e-15 of ``now``
    key = now - abs(now) * 1e-15 + min(far * ((1.0 - 1e-6) / FINE_M), 2.0 * COARSE * FINE)
    here, fine = np.int64(np.floor(now)), np.int64(np.floor(key))
    coarse = min(fine >> FINE_BITS, (here >> FINE_BITS) + COARSE - 1)
    nearby = hand * FINE + (fine & (FINE - 1))
    distant = COARSE_BEGIN + hand * COARSE + (coarse & (COARSE - 1))
    place = nearby if fine - here < FINE else distant
    return place if margin > 0 and key > now else BUCKETS - 1


@njit
def _advance(step, hands, rates, axes, cosines, sines, spans):  # type: ignore[no-untyped-def]
    """Move all hands by a step, and note for each the fine and the coarse buckets it passed: the
    first one's number and how many they are, in columns of ``spans`` [HANDS, 4].
    """
    length = np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    if length == 0.0:
        spans[:] = 0
        return
    rates[HANDS - 1] = 1.0  # metres per metre of the step
    for j in range(SECTORS):
        along = axes[j, 0] * step[0] + axes[j, 1] * step[1] + axes[j, 2] * step[2]
        advance = reach(along / length, cosines[j], sines[j])
        rates[2 * j] = advance
        rates[2 * j + 1] = max(advance + KAPPA, MU)
    for hand in range(HANDS):
        before = hands[hand]
        now = before + (rates[hand] + 1e-12) * length
        now += (abs(now) + abs(before)) * 2.3e-16
        hands[hand] = now
        fine, coarse = np.floor(before * (1.0 / FINE_M)), np.floor(before * (1.0 / COARSE_M)) + 1.0
        passed = np.float64(now > before)
        spans[hand, 0] = fine
        spans[hand, 1] = passed * min(np.floor(now * (1.0 / FINE_M)) - fine + 1.0, FINE)
        spans[hand, 2] = coarse
        spans[hand, 3] = passed * min(np.floor(now * (1.0 / COARSE_M)) - coarse + 1.0, COARSE)


@njit(forceinline=True)
def _take(bucket, heads, chunks, taken, count):  # type: ignore[no-untyped-def]
    """Empty a bucket and note its first chunk; the number of those noted.

    Without branches: whether there is something in it nobody could predict.
    """
    head = heads[bucket]
    heads[bucket] = -1
    taken[count] = head
    prefetch(chunks, np.intp(max(head, 0) >> 4) * (PER_CHUNK + 1))
    return count + np.intp(head >= 0)


@njit(cache=True, error_model="numpy", nogil=True)
def collect(step, hands, rates, heads, counts, chunks, axes, cosines, sines):  # type: ignore[no-untyped-def]
    """Move the hands by a step and return the nodes whose entries are due.

    Their entries are gone, their ``scheduled`` marks stay.
    """
    if len(chunks) == 0:
        return np.empty(0, np.int32)
    spans = np.empty((HANDS, 4), np.int32)
    _advance(step, hands, rates, axes, cosines, sines, spans)
    taken = np.empty(BUCKETS, np.int32)
    count = _take(BUCKETS - 1, heads, chunks, taken, 0)
    for hand in range(HANDS):
        later = min(hand + _HANDS_AHEAD, HANDS - 1)
        ahead = np.intp(spans[later, 2]) & (COARSE - 1)
        prefetch(heads, COARSE_BEGIN + later * COARSE + ahead)
        for fine in range(spans[hand, 0], spans[hand, 0] + spans[hand, 1]):
            bucket = hand * FINE + (fine & (FINE - 1))
            count = _take(bucket, heads, chunks, taken, count)
        for coarse in range(spans[hand, 2], spans[hand, 2] + spans[hand, 3]):
            bucket = COARSE_BEGIN + hand * COARSE + (coarse & (COARSE - 1))
            count = _take(bucket, heads, chunks, taken, count)
    due = _release(counts, chunks, taken[:count])
    counts[ENTRIES] -= len(due)
    return due


@njit
def _release(counts, chunks, taken):  # type: ignore[no-untyped-def]
    """The node ids in the buckets that began with these chunks; their chunks become free."""
    due = np.empty(counts[ENTRIES], np.int32)
    found = 0
    for head in taken:
        chunk, held = head >> 4, head & 15
        while chunk >= 0:
            for j in range(1, held + 1):
                due[found] = chunks[chunk, j]
                found += 1
            below = chunks[chunk, 0]
            chunks[chunk, 0] = counts[FREE]
            counts[FREE] = chunk
            chunk = below
            held = np.int32(PER_CHUNK)
    return due[:found]


@njit(forceinline=True)
def put(nodes, keys, buckets, hands, rates, heads, counts, chunks):  # type: ignore[no-untyped-def]
    """Make an entry for each node of a batch, by its keys (margin, way, sector). There must be
    chunks enough for all. ``buckets`` is for its own use.

    The buckets of all are found first, so that they can be asked for.
    """
    margins, ways, sectors = keys
    for i in range(len(nodes)):
        bucket = _bucket(margins[i], ways[i], sectors[i], hands, rates)
        buckets[i] = bucket
        prefetch(heads, bucket)
    for i in range(len(nodes)):
        if i + _NEAR < len(nodes):
            later = max(heads[buckets[i + _NEAR]], 0) >> 4
            prefetch(chunks, np.intp(later) * (PER_CHUNK + 1))
        head = heads[buckets[i]]
        if head < 0 or head & 15 == PER_CHUNK:
            fresh = counts[FREE]
            if fresh >= 0:
                counts[FREE] = chunks[fresh, 0]
            else:
                fresh = counts[USED]
                counts[USED] += 1
            chunks[fresh, 0] = head >> 4
            head = fresh << 4
        head += 1
        chunks[head >> 4, head & 15] = nodes[i]
        heads[buckets[i]] = head
    counts[ENTRIES] += len(nodes)


@njit(cache=True, error_model="numpy", nogil=True)
def insert(nodes, cx, cy, cz, k, grow, floats, refined, hands, rates, heads, counts, chunks):  # type: ignore[no-untyped-def]
    """Make an entry for each node, whose decision is known. There must be chunks enough for all."""
    rows = np.zeros((5, BATCH), np.float32)
    was = np.zeros(BATCH, np.bool_)
    margins, ways = np.empty(BATCH, np.float32), np.empty(BATCH, np.float32)
    sectors, buckets = np.empty(BATCH, np.int32), np.empty(BATCH, np.intp)
    for begin in range(0, len(nodes), BATCH):
        held = gather(nodes, begin, len(nodes), floats, refined, rows, was)
        find_keys(held, cx, cy, cz, k, grow, rows, was, margins, ways, sectors)
        batch = nodes[begin : begin + held]
        put(batch, (margins, ways, sectors), buckets, hands, rates, heads, counts, chunks)
