"""Projection units: transform, culls, conic and colour of every selected splat."""

from __future__ import annotations

from arch.component import Stream, UnitReport, ceil_div
from arch.config import AcceleratorConfig
from arch.memory.global_buffer import staging
from arch.memory.splat_record import CHANNELS, coefficients, record_bytes
from gaussians.work import FrameWork


def projection_unit(config: AcceleratorConfig, work: FrameWork) -> UnitReport:
    """Cycles = ceil((passes * submitted * II + right extras) / units).

    Independent eyes pass twice. A shared front end passes once, and a splat that survives the
    depth and opacity culls takes ``right_eye_cycles`` more where the right eye has its own conic
    and colour. Colour is evaluated for splats that reach a tile. The features of these are written
    to DRAM, once per eye that has its own.
    """
    front, unit = work.front_end, config.projection_unit
    passes = 1 if work.shared_front_end else 2
    own_right = work.right_projected or not work.shared_front_end
    eyes = 2 if own_right else 1
    shaped = front.projected + front.degenerate
    busy = passes * front.submitted * unit.timing.cycles_per_splat
    if work.shared_front_end and own_right:
        busy += shaped * unit.timing.right_eye_cycles
    record = record_bytes(config.splat_record, work.sh_degree)
    feature = config.volume_rendering_core.feature_buffer.record.record_bytes
    read_bytes = passes * front.submitted * record
    streams = (
        Stream("splat_records", "splats read for projection", read_bytes, granule_bytes=record),
        Stream(
            "feature_writes",
            "projected features of the visible splats written, per eye",
            write_bytes=front.visible * eyes * feature,
        ),
    )
    counts = {
        "splats_transformed": passes * front.submitted,
        "covariances_built": passes * shaped,
        "conics_computed": eyes * shaped,
        "sh_coefficients": eyes * front.visible * CHANNELS * coefficients(work.sh_degree),
        **staging(read_bytes),
    }
    return UnitReport(
        "projection_unit",
        unit.units.count,
        ceil_div(busy, unit.units.count),
        busy,
        unit.fill.latency_cycles,
        counts,
        streams,
    )
