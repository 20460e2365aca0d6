"""Stereo methods, one (splat, tile) pair at a time: the carrier rule alone, and every switch.

All columns are those of one plane of tiles that both windows look at: a left tile keeps its
number, a right tile t stands in column t + offset. Columns beyond the left window are tiles that
draw nothing and only forward.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians import reference
from gaussians.reference import ReferenceSplats
from gaussians.stereo_method import StereoMethod
from tests.naive.tiling import Bool, Float32, Lists


@dataclass
class Forwarding:
    """What the carrier rule makes of one frame."""

    fifo_entries: NDArray[np.int32]  # [rows, tiles_y, right tiles_x]
    forward_only: NDArray[np.int32]  # [tiles_y, plane columns], one for each right tile served
    right_lists: Lists = field(default_factory=list)


def carry(
    left: Lists, right: Lists, disparity_tiles: NDArray[np.int64], *, rows: int, offset_tiles: int
) -> Forwarding:
    """Send every splat of every right tile through its one carrier.

    ``left`` and ``right`` are the lists each eye would make for itself; ``disparity_tiles`` [M] is
    the disparity in tiles, rounded up.
    """
    tiles_y, left_width, right_width = len(left), len(left[0]), len(right[0])
    plane_width = max(left_width, right_width + offset_tiles)
    lowest = min(0, offset_tiles)  # the plane begins with the window further left
    fifos: dict[tuple[int, int, int], list[int]] = {}
    forward_only = np.zeros((tiles_y, plane_width - lowest), np.int32)
    for y in range(tiles_y):
        for t in range(right_width):
            for splat in right[y][t]:
                span = [x for x in range(left_width) if splat in left[y][x]]
                c = carrier(t + offset_tiles, int(disparity_tiles[splat]), span, rows, plane_width)
                fifos.setdefault((c - t - offset_tiles, y, t), []).append(splat)
                if c not in span:
                    forward_only[y, c - lowest] += 1
    entries = np.zeros((rows, tiles_y, right_width), np.int32)
    for key, queue in fifos.items():
        entries[key] = len(queue)
    merged = [
        [
            sorted(s for row in range(rows) for s in fifos.get((row, y, t), []))
            for t in range(right_width)
        ]
        for y in range(tiles_y)
    ]
    return Forwarding(entries, forward_only, merged)


def carrier(t: int, k: int, span: list[int], rows: int, plane_width: int) -> int:
    """Plane column of the tile that forwards to plane column ``t``; its row is carrier - t."""
    c = t + k
    if span:
        c = clamp(c, span[0], span[-1])
    return min(clamp(c, t, t + rows - 1), plane_width - 1)


def clamp(value: int, low: int, high: int) -> int:
    """The nearest integer in low..high."""
    return max(low, min(value, high))


@dataclass(frozen=True)
class LeftTiles:
    """The left tiles that forward, and what is known of their entries: [tile row][column]."""

    first_column: int  # plane column of column 0
    lists: Lists
    passing: list[list[set[int]]]  # splats that pass at one of the tile's pixels
    live_passing: list[list[set[int]]]  # those that do before the pixel has stopped
    walked: Lists  # the list's beginning, until the last pixel has stopped
    terminated: list[list[bool]]


@dataclass(frozen=True)
class Reprojection:
    """What a stereo method makes of one frame."""

    right_lists: Lists  # empty where the tile is binned on its own
    fifo_entries: NDArray[np.int32]  # [rows, tiles_y, tiles_x]; of a spilling method one row more
    forward_only: NDArray[np.int32]  # [tiles_y, columns that forward]
    first_column: int  # plane column of forward_only[:, 0]
    independent: set[tuple[int, int]]  # (tile row, column)
    dropped: int
    spilled: int
    unseen: int
    duplicates: int


def passing_window(splats: ReferenceSplats, columns: range, height: int) -> tuple[Bool, Float32]:
    """Where each splat passes, and its alpha; [M, height, columns], of any pixel columns."""
    shape = (len(splats.ids), height, len(columns))
    passing, alphas = np.zeros(shape, bool), np.zeros(shape, np.float32)
    x = np.array(columns, np.float32) + np.float32(0.5)
    y = np.arange(height, dtype=np.float32)[:, None] + np.float32(0.5)
    with np.errstate(all="ignore"):
        for i in range(len(splats.ids)):
            dx, dy = x - splats.u[i], y - splats.v[i]
            a, b, c = splats.a[i], splats.b[i], splats.c[i]
            p = np.float32(-0.5) * ((a * dx) * dx + (c * dy) * dy) - (b * dx) * dy
            passing[i] = (p <= 0) & (p >= splats.thresholds[i])
            power = reference.exp(np.where(passing[i], p, np.float32(0)))
            alphas[i] = np.minimum(np.float32(0.99), splats.opacities[i] * power)
    return passing, alphas


def left_tiles(
    lists: Lists, first_column: int, passing: Bool, alphas: Float32, tile_px: int
) -> LeftTiles:
    """Walk every left list; ``passing`` and ``alphas`` are those of the pixels of these tiles."""
    tiles = LeftTiles(first_column, lists, [], [], [], [])
    for y, row in enumerate(lists):
        for facts in (tiles.passing, tiles.live_passing, tiles.walked, tiles.terminated):
            facts.append([])
        for x, entries in enumerate(row):
            here = np.s_[:, y * tile_px : (y + 1) * tile_px, x * tile_px : (x + 1) * tile_px]
            live_passing, walked, live = walk(entries, passing[here], alphas[here])
            tiles.passing[y].append({s for s in entries if passing[here][s].any()})
            tiles.live_passing[y].append(live_passing)
            tiles.walked[y].append(walked)
            tiles.terminated[y].append(not live)
    return tiles


def walk(entries: list[int], passing: Bool, alphas: Float32) -> tuple[set[int], list[int], bool]:
    """Of one tile: what passes live pixels, what is walked, and whether a pixel is left live."""
    transmittance = np.ones(passing.shape[1:], np.float32)
    live = np.ones(passing.shape[1:], bool)
    live_passing, walked = set(), []
    for s in entries:
        if not live.any():
            break
        walked.append(s)
        passed = passing[s] & live
        if passed.any():
            live_passing.add(s)
        rest = transmittance * (1 - alphas[s])
        live = live & ~(passed & (rest < 1e-4))
        transmittance = np.where(passed & live, rest, transmittance)
    return live_passing, walked, bool(live.any())


def reproject(
    method: StereoMethod,
    left: LeftTiles,
    right: Lists,
    disparity: Float32,
    depths: Float32,
    shift: int,
) -> Reprojection:
    """The right eye's lists by ``method``, and what it took.

    ``right`` are the lists the right eye would make for itself, ``disparity`` [M] is in tiles, and
    ``shift`` the right window's offset in tiles.
    """
    machine = Machine(method, left, (len(right), len(right[0])), shift)
    if method.by_disparity:
        by_disparity(machine, disparity)
    else:
        by_footprint(machine, right, disparity)
    return machine.result(depths)


class Machine:
    """The stereo buffer of all right tiles; writes down what happens, and counts at the end."""

    def __init__(
        self, method: StereoMethod, left: LeftTiles, right_tiles: tuple[int, int], shift: int
    ) -> None:
        self.method, self.left, self.shift = method, left, shift
        self.tiles_y, self.tiles_x = right_tiles
        self.columns = range(left.first_column, left.first_column + len(left.lists[0]))
        if method.left_view == "forward_only":
            self.columns = range(min(0, shift), max(self.columns.stop, shift + self.tiles_x))
        edge = range(max(0, self.tiles_x - method.independent_edge_tiles), self.tiles_x)
        self.independent = {(y, t) for y in range(self.tiles_y) for t in edge}
        self.writes: list[tuple[int, int, int, int]] = []  # splat, tile row, right tile, buffer row
        self.added: list[tuple[int, int, int]] = []  # tile row, right tile, plane column
        self.dropped: list[tuple[int, int]] = []  # tile row, right tile
        self.unseen: list[tuple[int, int]] = []

    def put(self, splat: int, y: int, t: int, row: int) -> bool:
        """Into a row of right tile (y, t); where there is no such row, as the method says."""
        if not 0 <= row < self.method.rows:
            if self.method.out_of_range == "independent_tile":
                self.independent.add((y, t))
                return False
            if self.method.out_of_range == "drop":
                self.dropped.append((y, t))
                return False
            row = self.method.rows  # the way through memory
        self.writes.append((splat, y, t, row))
        return True

    def forwards(self, splat: int, y: int, column: int) -> bool:
        """Whether the splat's entry of this left list goes to the right eye."""
        left, x = self.left, column - self.left.first_column
        entries: dict[str, Any] = {
            "live_alpha_pass": left.live_passing,
            "alpha_pass": left.passing,
            "live_list": left.walked,
            "list": left.lists,
        }
        return splat in entries[self.method.forwarding][y][x]

    def too_late(self, splat: int, y: int, column: int) -> bool:
        """Whether the left tile has terminated before an entry added for the splat."""
        x = column - self.left.first_column
        if not self.method.stops_with_left_tile or not 0 <= x < len(self.left.lists[y]):
            return False
        return self.left.terminated[y][x] and splat > self.left.walked[y][x][-1]

    def result(self, depths: Float32) -> Reprojection:
        """Merge what the rows hold. A right tile on its own takes no part and loses nothing."""
        key = by_rank if self.method.tie == "id" else (lambda splat: float(depths[splat]))
        rows = self.method.rows + (self.method.out_of_range == "spill")
        queues: dict[tuple[int, int], list[list[int]]] = {
            (y, t): [[] for _ in range(rows)]
            for y in range(self.tiles_y)
            for t in range(self.tiles_x)
        }
        for splat, y, t, row in self.writes:
            if (y, t) not in self.independent:
                queues[y, t][row].append(splat)
        if self.method.out_of_range == "spill":
            for tile in queues.values():
                tile[-1].sort()
        forward_only = np.zeros((self.tiles_y, len(self.columns)), np.int32)
        for y, t, column in self.added:
            forward_only[y, column - self.columns[0]] += (y, t) not in self.independent
        entries = np.zeros((rows, self.tiles_y, self.tiles_x), np.int32)
        for (y, t), tile in queues.items():
            entries[:, y, t] = [len(queue) for queue in tile]
        lists = [
            [merge(queues[y, t], key) for t in range(self.tiles_x)] for y in range(self.tiles_y)
        ]
        merged = sum(len(tile) for row in lists for tile in row)
        return Reprojection(
            right_lists=lists,
            fifo_entries=entries,
            forward_only=forward_only,
            first_column=self.columns[0],
            independent=self.independent,
            dropped=sum(tile not in self.independent for tile in self.dropped),
            spilled=int(entries[self.method.rows :].sum()),
            unseen=sum(tile not in self.independent for tile in self.unseen),
            duplicates=int(entries.sum()) - merged,
        )


def draw(
    splats: ReferenceSplats,
    lists: Lists,
    shape: tuple[int, int],
    tile_px: int,
    background: tuple[float, float, float],
) -> Float32:
    """[height, width, 3] what the lists draw, in their own order, before the background."""
    passing, alphas = passing_window(splats, range(shape[1]), shape[0])
    image, t = np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32)
    live = np.ones(shape, bool)
    for y, row in enumerate(lists):
        for x, entries in enumerate(row):
            here = np.s_[y * tile_px : (y + 1) * tile_px, x * tile_px : (x + 1) * tile_px]
            for s in entries:
                rest = t[here] * (1 - alphas[s][here])
                passed = live[here] & passing[s][here]
                live[here] &= ~(passed & (rest < 1e-4))
                blend = passed & live[here]
                weight = np.where(blend, alphas[s][here] * t[here], np.float32(0))
                image[here] += splats.rgb[s] * weight[..., None]
                t[here] = np.where(blend, rest, t[here])
    return image + t[..., None] * np.array(background, np.float32)


def by_rank(splat: int) -> float:
    """Ranks are the order of (depth, id)."""
    return splat


def merge(queues: list[list[int]], key: Callable[[int], float]) -> list[int]:
    """The smallest head first, of equal keys that of the lowest row; equal heads leave as one."""
    queues, merged = [list(queue) for queue in queues], []
    while any(queues):
        splat = min((q[0] for q in queues if q), key=key)  # min keeps the first of equals
        merged.append(splat)
        for queue in queues:
            while queue and queue[0] == splat:
                queue.pop(0)
    return merged


def moved(insertion: str, tiles: np.float32) -> list[int]:
    """By how many tiles a splat of this disparity is moved: one number or two."""
    if not np.isfinite(tiles):
        return []
    floor = math.floor(tiles)
    if insertion == "floor":
        return [floor]
    if insertion == "round":
        return [math.floor(tiles + np.float32(0.5))]
    return [floor] if tiles == floor else [floor, floor + 1]


def by_disparity(machine: Machine, disparity: Float32) -> None:
    """Every forwarded left entry, moved left by the splat's disparity."""
    left = machine.left
    for y, row in enumerate(left.lists):
        for x, entries in enumerate(row):
            column = left.first_column + x
            for splat in entries:
                if machine.forwards(splat, y, column):
                    for k in moved(machine.method.insertion, disparity[splat]):
                        t = column - k - machine.shift
                        if 0 <= t < machine.tiles_x:
                            machine.put(splat, y, t, k)


def by_footprint(machine: Machine, right: Lists, disparity: Float32) -> None:
    """Every right tile of the right footprint, from one left tile."""
    for y, row in enumerate(right):
        for t, splats in enumerate(row):
            for splat in splats:
                carry_one(machine, splat, y, t, math.ceil(disparity[splat]))


def carry_one(machine: Machine, splat: int, y: int, t: int, k: int) -> None:
    """One splat to one right tile, which stands in plane column t + shift."""
    method, left, columns = machine.method, machine.left, machine.columns
    place = t + machine.shift
    holders = [left.first_column + x for x, tile in enumerate(left.lists[y]) if splat in tile]
    column = place + k
    if holders:
        column = clamp(column, holders[0], holders[-1])
    if method.left_view == "forward_only":
        column = clamp(column, columns[0], columns[-1])
    seen = column in columns and (holders or method.insertion == "carrier")
    if seen and method.out_of_range == "forward_only":
        column = clamp(column, place, place + method.rows - 1)
        seen = column in columns
    if not seen:
        machine.unseen.append((y, t))
    elif column in holders:
        if machine.forwards(splat, y, column):
            machine.put(splat, y, t, column - place)
    elif not machine.too_late(splat, y, column) and machine.put(splat, y, t, column - place):
        machine.added.append((y, t, column))
