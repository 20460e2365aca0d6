"""One stereo frame, stage by stage: projection, binning, lists, left eye, forwarding, right eye."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.projection import ProjectedSplats, project
from gaussians.rasterization import EyeImage, rasterise
from gaussians.scene import Scene
from gaussians.spherical_harmonics import fill_colours
from gaussians.stereo import StereoForwarding, StereoMethod, forward, right_features
from gaussians.tiling import RowSpans, TileGrid, TileLists, row_spans, tile_lists
from gaussians.work import FrameWork, FrontEndWork, StereoWork

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
    of (scene, rig, background) alone, bit for bit. ``compare`` also renders the right eye from its
    own projection and its own lists of the method's intersection rule: what the method is judged
    against.
    """
    grid = TileGrid(rig.display.width, rig.display.height, tile_px)
    splats = project(scene, rig)
    rows = row_spans(splats, grid, method.intersection)
    visible = _colour(scene, rig, splats, rows)
    in_eyes = int(visible[0].sum()), int(visible[1].sum())
    left_lists = tile_lists(rows, 0)
    paper = method.forwarding == "live_alpha_pass"
    left = rasterise(splats.features[0], left_lists, grid, background, record_passes=paper)
    if method.forwarding == "none":
        forwarding = None
        right_lists = tile_lists(rows, 1)
        right = rasterise(splats.features[1], right_lists, grid, background)
    else:
        forwarding = forward(splats, rows, left_lists, left.live_passes, rig, method)
        right_lists = forwarding.lists
        right = _right_eye(splats, rows, right_lists, rig, method, background)
    own_right = None
    if compare:
        own_right = rasterise(splats.features[1], tile_lists(rows, 1), grid, background).image
    return StereoFrame(
        left.image,
        right.image,
        left.transmittance,
        right.transmittance,
        left_lists,
        right_lists,
        splats.ids,
        _frame_work(
            scene, method, splats, rows, int(visible.any(0).sum()), left, right, forwarding
        ),
        in_eyes,
        own_right,
    )


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
    visible = np.zeros((splats.eyes, len(splats.ids)), np.bool_)
    for eye, spans in zip(visible, rows.spans, strict=True):
        eye[rows.ranks[spans[:, 0] <= spans[:, 1]]] = True
    needed = np.any(visible, axis=0)
    positions = (rig.left_position, rig.right_position)
    for features, position in zip(splats.features, positions, strict=False):
        fill_colours(features, splats.ids, needed, scene.means, scene.sh, position)
    return visible


def _right_eye(
    splats: ProjectedSplats,
    rows: RowSpans,
    lists: TileLists,
    rig: StereoRig,
    method: StereoMethod,
    background: Colour,
) -> EyeImage:
    grid = rows.grid
    edge = grid.tiles_x - min(method.independent_edge_tiles, grid.tiles_x)
    features = right_features(splats, rig, method)
    right = rasterise(features, lists, grid, background, columns=(0, edge))
    if edge == grid.tiles_x:
        return right
    own, columns = tile_lists(rows, 1), (edge, grid.tiles_x)
    return rasterise(splats.features[1], own, grid, background, columns=columns, onto=right)


def _frame_work(
    scene: Scene,
    method: StereoMethod,
    splats: ProjectedSplats,
    rows: RowSpans,
    visible: int,
    left: EyeImage,
    right: EyeImage,
    forwarding: StereoForwarding | None,
) -> FrameWork:
    grid = rows.grid
    stereo = StereoWork(
        fifo_entries=np.zeros((method.rows, grid.tiles_y, grid.tiles_x), np.int32),
        forward_only=np.zeros((grid.tiles_y, grid.tiles_x), np.int32),
        walked_after_termination=np.zeros((grid.tiles_y, grid.tiles_x), np.int32),
        dropped=0,
        duplicates=0,
    )
    if forwarding is not None:
        rest = np.zeros_like(forwarding.forward_only)
        if method.forwarding == "carrier":
            first = max(0, -forwarding.shift)  # plane column of the left window's first tile
            window = rest[:, first : first + grid.tiles_x]
            window[:] = left.work.entries - left.work.processed
        stereo = StereoWork(
            fifo_entries=forwarding.fifo_entries,
            forward_only=forwarding.forward_only,
            walked_after_termination=rest,
            dropped=forwarding.dropped,
            duplicates=forwarding.duplicates,
        )
    edge_tiles = min(method.independent_edge_tiles, grid.tiles_x) * grid.tiles_y
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
            visible=visible,
            row_entries=len(rows.ranks),
            left_pairs=int(rows.counts[0].sum()),
            right_pairs=int(rows.counts[1].sum()),
        ),
        left=left.work,
        right=right.work,
        stereo=stereo,
        independent_right_tiles=edge_tiles
        if forwarding is not None
        else grid.tiles_x * grid.tiles_y,
    )
