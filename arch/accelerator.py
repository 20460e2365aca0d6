"""The accelerator at `analytic` fidelity: bounds per unit from the counters of one stereo frame.

Reads like the block diagram (Fig. 14): decoder and subgraph unit, projection, binning, sorting, the
volume rendering cores with SRU, stereo buffer and merge unit, and DRAM beneath all of them.
"""

from __future__ import annotations

import math

from arch.activity import Activity
from arch.client_work import ClientWork
from arch.component import UnitReport
from arch.config import AcceleratorConfig
from arch.memory.dram import DramReport, activations, dram
from arch.results import FrameAnalysis, FrameTiming, StreamBytes, UnitTiming
from arch.units.binning_unit import binning_unit
from arch.units.decoder import decoder
from arch.units.projection_unit import projection_unit
from arch.units.sorting_unit import sorting_unit
from arch.units.subgraph_unit import subgraph_unit
from arch.units.volume_rendering_core import RasterReport, volume_rendering_cores
from arch.work_check import check_work
from gaussians.work import FrameWork

FIDELITY = "analytic"
OVERLAP = (
    "All stages work at once, on tiles and on successive frames: decoding, selection, projection "
    "and binning of a frame run while the frame before is sorted and rendered. Frame time = "
    "slowest unit + pipeline fill of every unit once. DRAM is one shared unit that moves the "
    "bytes of all stages."
)
HOST_DECODES = (
    "no decoder is built: payloads are decoded by the host, whose time and energy are not counted; "
    "its DRAM traffic is"
)


def analyse_frame(config: AcceleratorConfig, work: FrameWork, client: ClientWork) -> FrameAnalysis:
    """Cycles, bound, utilisation, DRAM bytes and activity of one stereo frame.

    Raises InputError where work and configuration do not belong together (tile size, stereo rows, a
    stereo method on an accelerator without stereo units, counts that contradict each other).
    """
    check_work(config, work, client)
    raster = volume_rendering_cores(config, work)
    units = (
        decoder(config, work, client),
        subgraph_unit(config, client),
        projection_unit(config, work),
        binning_unit(config, work),
        sorting_unit(config, work),
        *raster.units,
    )
    scan_rate = 2.0 * work.width * work.height * config.display.bytes_per_pixel_and_s
    memory = dram(config, tuple(s for unit in units for s in unit.streams), scan_rate)
    timing = _timing(config, units, raster, memory, scan_rate, client)
    activity = _activity(config, units, memory, timing, client)
    return FrameAnalysis(timing, activity)


def _timing(
    config: AcceleratorConfig,
    units: tuple[UnitReport, ...],
    raster: RasterReport,
    memory: DramReport,
    scan_rate: float,
    client: ClientWork,
) -> FrameTiming:
    dram_unit = UnitReport("dram", 1, memory.cycles, memory.cycles, config.dram.fill.latency_cycles)
    everything = (*units, dram_unit)
    bound = max(everything, key=lambda unit: unit.cycles)
    fill = sum(unit.latency_cycles for unit in everything)
    cycles = bound.cycles + fill
    seconds = cycles * config.cycle_s
    scanned = math.ceil(scan_rate * seconds)
    scan = StreamBytes("display_scan_out", "both images read by the display", scanned, 0)
    host = config.decoder is None and client.decoded_splats > 0
    return FrameTiming(
        fidelity=FIDELITY,
        cycles_per_frame=cycles,
        fill_cycles=fill,
        frame_ms=seconds * 1e3,
        fps=1.0 / seconds,
        bound_by=bound.name,
        units=tuple(_unit_timing(unit, cycles) for unit in everything),
        stalls=raster.stalls,
        dram=(*memory.streams, scan),
        dram_bytes=memory.total_bytes + scanned,
        dram_efficiency=memory.efficiency,
        stereo_buffer=raster.stereo_buffer,
        overlap=OVERLAP,
        notes=(HOST_DECODES,) if host else (),
    )


def _unit_timing(unit: UnitReport, cycles: int) -> UnitTiming:
    share = unit.busy_cycles / (unit.instances * cycles) if unit.instances else 0.0
    return UnitTiming(unit.name, unit.instances, unit.cycles, unit.busy_cycles, share)


def _activity(
    config: AcceleratorConfig,
    units: tuple[UnitReport, ...],
    memory: DramReport,
    timing: FrameTiming,
    client: ClientWork,
) -> Activity:
    """Unit counters, and the DRAM's with the display's reading of the frame time."""
    scanned = timing.dram[-1].read_bytes
    outside = {
        "radio_bytes_received": client.received_bytes,
        "dram_activations": memory.activations + activations(config.dram, scanned, 0),
        "dram_bytes_read": sum(s.read_bytes for s in timing.dram),
        "dram_bytes_written": sum(s.write_bytes for s in timing.dram),
    }
    return Activity.collect([*(unit.counts for unit in units), outside])
