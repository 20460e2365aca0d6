"""What one frame of a run is measured by: stereo exactness, coverage, work, time and energy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arch import (
    AcceleratorConfig,
    CostTable,
    EnergyReport,
    FrameAnalysis,
    Technology,
    analyse_frame,
    frame_energy,
)
from gaussians.quality import mismatching_pixels, mismatching_pixels_8bit, psnr_db
from gaussians.render import StereoFrame
from nebula.session import ClientFrame

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Hardware:
    """The accelerator that is timed, and what its actions cost."""

    config: AcceleratorConfig
    costs: CostTable
    technology: Technology


@dataclass(frozen=True)
class FrameRecord:
    """One measured frame; images are not kept."""

    index: int
    time_s: float
    eye_m: tuple[float, float, float]
    searched: bool
    received_bytes: int
    drawn_splats: int
    held_splats: int
    visible: tuple[int, int]
    covered: tuple[float, float]
    mismatching: int
    mismatching_8bit: int
    squared_error: float  # mean over pixels and channels of the right eye, clipped to 0..1
    list_entries: tuple[int, int]
    forward_only: int
    after_termination: int
    row_writes: int
    dropped: int
    duplicates: int
    ill_conditioned: int
    analysis: FrameAnalysis
    energy: EnergyReport


def covered_shares(frame: StereoFrame) -> tuple[float, float]:
    """Share of each eye's pixels in which at least one splat was blended."""
    return (
        float((frame.left_transmittance < 1).mean()),
        float((frame.right_transmittance < 1).mean()),
    )


def own_right(frame: StereoFrame) -> Float32:
    """The independently rendered right eye of a frame that was rendered with ``compare``."""
    assert frame.independent_right is not None
    return frame.independent_right


def measure(
    index: int,
    time_s: float,
    eye_m: NDArray[np.float64],
    client: ClientFrame,
    frame: StereoFrame,
    hardware: Hardware,
) -> FrameRecord:
    """Compare, count, time and price one frame rendered with ``compare``."""
    work, stereo = frame.work, frame.work.stereo
    analysis = analyse_frame(hardware.config, work, client.work)
    energy = frame_energy(
        hardware.config, analysis.activity, analysis.timing, hardware.costs, hardware.technology
    )
    own = own_right(frame)
    mismatching = mismatching_pixels(frame.right, own)
    psnr = psnr_db(frame.right, own) if mismatching else None
    x, y, z = (float(c) for c in eye_m)
    return FrameRecord(
        index=index,
        time_s=time_s,
        eye_m=(x, y, z),
        searched=client.searched,
        received_bytes=client.received_bytes,
        drawn_splats=len(client.selection.node_ids),
        held_splats=client.selection.held,
        visible=frame.visible,
        covered=covered_shares(frame),
        mismatching=mismatching,
        mismatching_8bit=mismatching_pixels_8bit(frame.right, own) if mismatching else 0,
        squared_error=0.0 if psnr is None else 10.0 ** (-psnr / 10.0),
        list_entries=(int(work.left.entries.sum()), int(work.right.entries.sum())),
        forward_only=int(stereo.forward_only.sum()),
        after_termination=int(stereo.walked_after_termination.sum()),
        row_writes=int(stereo.fifo_entries.sum()),
        dropped=stereo.dropped,
        duplicates=stereo.duplicates,
        ill_conditioned=work.front_end.ill_conditioned,
        analysis=analysis,
        energy=energy,
    )
