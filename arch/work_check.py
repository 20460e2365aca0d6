"""Refuses a work trace that does not belong to the accelerator it is timed on."""

from __future__ import annotations

import dataclasses

import numpy as np

from arch.client_work import ClientWork
from arch.config import AcceleratorConfig
from gaussians.errors import InputError
from gaussians.work import FrameWork


def check_work(config: AcceleratorConfig, work: FrameWork, client: ClientWork) -> None:
    """Raise InputError naming the first thing in which configuration, trace and client disagree."""
    if work.tile_px != config.workload.tile.edge_px:
        raise InputError(
            f"{config.name}: the work trace must have {config.workload.tile.edge_px} px tiles, "
            f"not {work.tile_px}; another tile size needs a new trace"
        )
    if not 0 <= work.sh_degree <= 3:
        raise InputError(f"work trace: sh_degree must lie in 0..3, not {work.sh_degree}")
    if client.selected_splats < work.front_end.submitted:
        raise InputError(
            f"client work: selected_splats must be at least the {work.front_end.submitted} splats "
            f"submitted to projection, not {client.selected_splats}"
        )
    _check_shapes(work)
    _check_stereo(config, work)


def _check_shapes(work: FrameWork) -> None:
    tiles = (-(-work.height // work.tile_px), -(-work.width // work.tile_px))
    for name, eye in (("left", work.left), ("right", work.right)):
        for field in dataclasses.fields(eye):
            shape = getattr(eye, field.name).shape
            if shape != tiles:
                raise InputError(
                    f"work trace: {name}.{field.name} must have shape {tiles}, not {shape}"
                )
    fifo = work.stereo.fifo_entries.shape
    if fifo[1:] != tiles or len(fifo) != 3:
        raise InputError(
            f"work trace: stereo.fifo_entries must have shape (rows, {tiles[0]}, {tiles[1]}), "
            f"not {fifo}"
        )
    for name in ("forward_only", "walked_after_termination"):
        shape = getattr(work.stereo, name).shape
        if len(shape) != 2 or shape[0] != tiles[0] or shape[1] < tiles[1]:
            raise InputError(
                f"work trace: stereo.{name} must have shape ({tiles[0]}, {tiles[1]} or more), "
                f"not {shape}"
            )


def _check_stereo(config: AcceleratorConfig, work: FrameWork) -> None:
    forwarded = bool(np.any(work.stereo.fifo_entries))
    if not work.shared_front_end:
        if forwarded:
            raise InputError("work trace: independent eyes must not have stereo-buffer entries")
        return
    if config.stereo is None:
        raise InputError(
            f"{config.name}: has no stereo units, so the frame must be rendered with the method "
            f"'independent', not '{work.method}'"
        )
    rows = work.stereo.fifo_entries.shape[0]
    if rows > config.stereo.buffer.rows:
        raise InputError(
            f"{config.name}: the stereo buffer has {config.stereo.buffer.rows} rows, so the frame "
            f"must be rendered with at most as many, not {rows}"
        )
