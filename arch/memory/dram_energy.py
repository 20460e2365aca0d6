"""DRAM energy from IDD currents by state, per channel of one x32 device, without input/output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from arch.costs import DramRail
from arch.memory.config import DramConfig
from arch.memory.dram import channel_bytes_per_ns


@dataclass(frozen=True)
class DramEnergy:
    """What the states of one channel cost."""

    activate_pj: float  # open and close one row
    read_pj_per_bit: float
    write_pj_per_bit: float
    active_standby_mw: float
    refresh_pj: float  # one refresh command
    refresh_mw: float  # mean


def dram_energy(config: DramConfig, rails: tuple[DramRail, ...]) -> DramEnergy:
    """Sum over the supplies V of

    activate V (IDD0 tRC - IDD3N tRAS - IDD2N (tRC - tRAS)), burst V (IDD4 - IDD3N) tBURST, refresh
    V (IDD5 - IDD3N) tRFC, standby V IDD3N. mW x ns = pJ.
    """
    timing, burst = config.timing, config.organisation.burst_bytes
    burst_ns = burst / channel_bytes_per_ns(config)
    closed_ns = timing.t_rc_ns - timing.t_ras_ns
    refresh_mw = _milliwatts(rails, lambda r: r.idd5_ma - r.idd3n_ma)
    refresh_pj = refresh_mw * timing.t_rfc_ns
    return DramEnergy(
        activate_pj=_milliwatts(
            rails,
            lambda r: (
                r.idd0_ma * timing.t_rc_ns - r.idd3n_ma * timing.t_ras_ns - r.idd2n_ma * closed_ns
            ),
        ),
        read_pj_per_bit=_milliwatts(rails, lambda r: r.idd4r_ma - r.idd3n_ma)
        * burst_ns
        / burst
        / 8,
        write_pj_per_bit=_milliwatts(rails, lambda r: r.idd4w_ma - r.idd3n_ma)
        * burst_ns
        / burst
        / 8,
        active_standby_mw=_milliwatts(rails, lambda r: r.idd3n_ma),
        refresh_pj=refresh_pj,
        refresh_mw=refresh_pj / timing.t_refi_ns,
    )


def _milliwatts(rails: tuple[DramRail, ...], current_ma: Callable[[DramRail], float]) -> float:
    return sum(rail.voltage_v * current_ma(rail) for rail in rails)
