"""One stereo frame, stage by stage: projection, binning, lists, left eye, forwarding, right eye."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.constants import OPACITY
from gaussians.footprints import Intersection
from gaussians.left_view import LeftEye, clip_to_virtual_camera, widened
from gaussians.projection import ProjectedSplats, project
from gaussians.rasterization import EyeImage, rasterise
from gaussians.scene import Scene
from gaussians.spherical_harmonics import fill_colours
from gaussians.stereo_method import StereoMethod
from gaussians.stereo_reprojection import StereoForwarding, forward, right_features
from gaussians.tiling import RowSpans, TileGrid, TileLists, offsets_of, row_spans, tile_lists
from gaussians.work import EyeWork, FrameWork, FrontEndWork, StereoWork

Float32 = NDArray[np.float32]
Colour = tuple[float, float, float]
BLACK: Colour = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StereoFrame:
    """Both images of one frame, the lists they were made from, and the work they took."""

    left: Float32  # [H, W, 3]
    right: Float32  # [H, W, 3]
    left_transmittance: Float32  # [H, W]
    right_transmittance: Float32  # [H, W]
    left_lists: TileLists
    right_lists: TileLists
    ids: NDArray[np.int32]  # rank -> id in the scene
    work: FrameWork
    visible: tuple[int, int]  # splats in at least one tile of the left and of the right eye
    independent_right: Float32 | None = None  # right eye rendered on its own, where asked for


class StereoRenderer:
    """Renders one pose by any number of stereo methods and keeps what they share.

    Owns the projected splats and, per intersection rule, the row spans and the left eye.
    """

    def __init__(
        self, scene: Scene, rig: StereoRig, background: Colour = BLACK, tile_px: int = 4
    ) -> None:
        self._scene, self._rig, self._background = scene, rig, background
        self._grid = TileGrid(rig.display.width, rig.display.height, tile_px)
        self._splats = project(scene, rig)
        self._rows: dict[tuple[Intersection, bool], _Binned] = {}
        self._lefts: dict[tuple[Intersection, bool, bool], LeftEye] = {}
        self._reference: EyeImage | None = None

    def independent_right(self) -> EyeImage:
        """The right eye from its own projection and its own ellipse lists."""
        if self._reference is None:
            self._reference = self._own_right("ellipse")
        return self._reference

    def render(self, method: StereoMethod, *, compare: bool = False) -> StereoFrame:
        """Both eyes by ``method``; see `render_stereo`."""
        binned = self._binned(method.intersection)
        left = self._left(method)
        forwarding = None
        if method.forwarding == "none":
            right_lists = tile_lists(binned.rows, 1)
            right = self._raster(self._splats.features[1], right_lists)
        else:
            left = self._marked(method, left)
            forwarding = forward(self._splats, binned.rows, left, self._rig, method)
            right_lists = forwarding.lists
            right = self._raster(right_features(self._splats, self._rig, method), right_lists)
            if forwarding.independent.any():
                own = self._own_right(method.intersection, forwarding.independent)
                right = _patched(right, own, forwarding.independent, self._grid)
        first = -left.grid.first_column * left.grid.tile_px
        window = slice(first, first + self._grid.width)
        return StereoFrame(
            np.ascontiguousarray(left.eye.image[:, window]),
            right.image,
            np.ascontiguousarray(left.eye.transmittance[:, window]),
            right.transmittance,
            left.lists,
            right_lists,
            self._splats.ids,
            _frame_work(self._scene, method, self._splats, binned, left, right, forwarding),
            binned.in_eyes,
            self.independent_right().image if compare else None,
        )

    def _binned(self, intersection: Intersection, wide: bool = False) -> _Binned:
        key = intersection, wide
        if key not in self._rows:
            grid = widened(self._rig, self._grid) if wide else self._grid
            rows = row_spans(self._splats, grid, intersection)
            visible = _colour(self._scene, self._rig, self._splats, rows)
            if wide:
                rows = clip_to_virtual_camera(rows, self._splats, self._rig, self._grid)
            in_eyes = int(visible[0].sum()), int(visible[1].sum())
            self._rows[key] = _Binned(rows, in_eyes, int(visible.any(0).sum()))
        return self._rows[key]

    def _left(self, method: StereoMethod) -> LeftEye:
        wide = method.left_view == "widened" and method.forwarding != "none"
        passes = method.forwarding == "live_alpha_pass"
        key = method.intersection, wide, passes
        if key not in self._lefts:
            rows = self._binned(method.intersection, wide).rows
            lists, features = tile_lists(rows, 0), self._splats.features[0]
            eye = self._raster(features, lists, rows.grid, record_passes=passes)
            self._lefts[key] = LeftEye(rows.grid, rows.spans[0], lists, eye, eye.live_passes)
        return self._lefts[key]

    def _marked(self, method: StereoMethod, left: LeftEye) -> LeftEye:
        """With the marks of what is forwarded, and the checks it takes to know."""
        if method.forwarding == "alpha_pass":  # where nothing covers, nothing terminates
            uncovering = self._splats.features[0].copy()
            uncovering[:, OPACITY] = 0
            all_of_it = self._raster(uncovering, left.lists, left.grid, record_passes=True)
            work = replace(left.eye.work, alpha_checks=all_of_it.work.alpha_checks)
            eye = replace(left.eye, work=work)
            return replace(left, eye=eye, forwards=all_of_it.live_passes)
        if method.forwarding == "live_list":
            lengths = left.lists.lengths.ravel()
            place = np.arange(len(left.lists.splats)) - np.repeat(left.lists.offsets[:-1], lengths)
            walked = np.repeat(left.eye.work.processed.ravel(), lengths)
            return replace(left, forwards=(place < walked).astype(np.uint8))
        return left

    def _own_right(
        self, intersection: Intersection, tiles: NDArray[np.bool_] | None = None
    ) -> EyeImage:
        """The right eye without the left one, in all tiles or in some."""
        lists = tile_lists(self._binned(intersection).rows, 1)
        if tiles is not None:
            kept = np.repeat(tiles.ravel(), lists.lengths.ravel())
            offsets = offsets_of(np.where(tiles, lists.lengths, 0))
            lists = TileLists(lists.tiles_x, lists.tiles_y, offsets, lists.splats[kept])
        return self._raster(self._splats.features[1], lists)

    def _raster(
        self,
        features: Float32,
        lists: TileLists,
        grid: TileGrid | None = None,
        *,
        record_passes: bool = False,
    ) -> EyeImage:
        background = self._background
        return rasterise(
            features, lists, grid or self._grid, background, record_passes=record_passes
        )


class _Binned(NamedTuple):
    rows: RowSpans
    in_eyes: tuple[int, int]  # splats in at least one tile of the left and of the right eye
    visible: int  # of either


def render_stereo(
    scene: Scene,
    rig: StereoRig,
    method: StereoMethod,
    background: Colour = BLACK,
    tile_px: int = 4,
    *,
    compare: bool = False,
) -> StereoFrame:
    """Render both eyes of ``rig`` by a stereo method.

    With ellipse lists the left image, and the right one of `independent` and `exact`, are functions
    of (scene, rig, background) alone, bit for bit. ``compare`` also renders the right eye by the
    preset `independent`: what the method is judged against.
    """
    return StereoRenderer(scene, rig, background, tile_px).render(method, compare=compare)


def render_mono(
    scene: Scene, rig: StereoRig, background: Colour = BLACK, tile_px: int = 8
) -> tuple[Float32, Float32]:
    """Image [H, W, 3] and transmittance [H, W] of the left eye alone."""
    grid = TileGrid(rig.display.width, rig.display.height, tile_px)
    splats = project(scene, rig, eyes=1)
    rows = row_spans(splats, grid)
    _colour(scene, rig, splats, rows)
    eye = rasterise(splats.features[0], tile_lists(rows, 0), grid, background)
    return eye.image, eye.transmittance


def _colour(
    scene: Scene, rig: StereoRig, splats: ProjectedSplats, rows: RowSpans
) -> NDArray[np.bool_]:
    """[eyes, M] which splats stand in a tile; fills the colours of those that stand in any."""
    needed = np.any(rows.visible, axis=0)
    positions = np.stack([rig.left_position, rig.right_position])[: splats.eyes]
    fill_colours(splats.features, splats.ids, needed, scene.means, scene.sh, positions)
    return rows.visible


def _patched(right: EyeImage, own: EyeImage, tiles: NDArray[np.bool_], grid: TileGrid) -> EyeImage:
    """``right`` with the tiles that were binned on their own; the work of both."""
    pixels = tiles.repeat(grid.tile_px, axis=0).repeat(grid.tile_px, axis=1)
    pixels = pixels[: grid.height, : grid.width]
    work = EyeWork(
        *(getattr(right.work, f.name) + getattr(own.work, f.name) for f in fields(EyeWork))
    )
    return EyeImage(
        np.where(pixels[:, :, None], own.image, right.image),
        np.where(pixels, own.transmittance, right.transmittance),
        work,
        right.live_passes,
    )


def _frame_work(
    scene: Scene,
    method: StereoMethod,
    splats: ProjectedSplats,
    binned: _Binned,
    left: LeftEye,
    right: EyeImage,
    forwarding: StereoForwarding | None,
) -> FrameWork:
    rows, grid = binned.rows, binned.rows.grid
    return FrameWork(
        width=grid.width,
        height=grid.height,
        tile_px=grid.tile_px,
        sh_degree=scene.sh_degree,
        method=str(method),
        shared_front_end=forwarding is not None,
        right_projected=forwarding is None or "per_eye" in (method.conic, method.colour),
        front_end=FrontEndWork(
            submitted=len(scene),
            behind_near=splats.behind_near,
            transparent=splats.transparent,
            degenerate=splats.degenerate,
            ill_conditioned=rows.ill_conditioned,
            projected=len(splats.ids),
            visible=binned.visible,
            row_entries=len(rows.ranks),
            left_pairs=int(rows.counts[0].sum()),
            right_pairs=int(rows.counts[1].sum()),
        ),
        left=left.eye.work,
        right=right.work,
        stereo=_stereo_work(method, grid, left, forwarding),
        independent_right_tiles=grid.tiles_x * grid.tiles_y
        if forwarding is None
        else int(forwarding.independent.sum()),
    )


def _stereo_work(
    method: StereoMethod, grid: TileGrid, left: LeftEye, forwarding: StereoForwarding | None
) -> StereoWork:
    if forwarding is None:
        nothing = np.zeros((grid.tiles_y, grid.tiles_x), np.int32)
        rows = np.zeros((method.rows, *nothing.shape), np.int32)
        return StereoWork(rows, nothing, nothing, 0, 0, 0, 0)
    after = np.zeros_like(forwarding.forward_only)
    if method.walks_past_termination:
        first = left.grid.first_column - forwarding.first_column
        window = after[:, first : first + left.grid.tiles_x]
        window[:] = left.eye.work.entries - left.eye.work.processed
    return StereoWork(
        fifo_entries=forwarding.fifo_entries,
        forward_only=forwarding.forward_only,
        walked_after_termination=after,
        dropped=forwarding.dropped,
        spilled=forwarding.spilled,
        unseen=forwarding.unseen,
        duplicates=forwarding.duplicates,
    )
