"""Subgraph unit: per frame, level-of-detail selection and frustum cull over all held headers."""

from __future__ import annotations

from arch.client_work import ClientWork
from arch.component import Stream, UnitReport, ceil_div
from arch.config import AcceleratorConfig


def subgraph_unit(config: AcceleratorConfig, client: ClientWork) -> UnitReport:
    """Cycles = ceil(held headers / (units * headers per cycle)).

    Every held header is read; new and evicted records write one header each. The selected ids go to
    projection through a queue, not through DRAM.
    """
    units, timing = config.subgraph_unit.units, config.subgraph_unit.timing
    cycles = ceil_div(client.held_splats, units.count * timing.headers_per_cycle)
    changed = client.decoded_splats + client.evicted_splats
    stream = Stream(
        "headers",
        "headers of the held splats walked, and those of new and evicted splats written",
        read_bytes=client.held_splats * timing.header_bytes,
        write_bytes=changed * timing.header_bytes,
    )
    return UnitReport(
        "subgraph_unit",
        units.count,
        cycles,
        ceil_div(client.held_splats, timing.headers_per_cycle),
        config.subgraph_unit.fill.latency_cycles,
        {"headers_walked": client.held_splats},
        (stream,),
    )
