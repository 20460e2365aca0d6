"""Cycle, energy and area model of the accelerator (Sec. 5 and 6).

Values come from ``gaussians``; this package turns the counts of a work trace into time, energy and
area, and names the source of every number it uses.
"""

from arch.accelerator import analyse_frame
from arch.activity import COUNTERS, Activity, Count
from arch.area import AreaPart, AreaReport, area, with_cores
from arch.client_work import ClientWork
from arch.config import AcceleratorConfig
from arch.costs import CostTable
from arch.energy import EnergyPart, EnergyReport, frame_energy
from arch.paper_comparison import PaperFigure, paper_comparison
from arch.provenance import SourcedGroup, sourced_groups
from arch.results import FrameAnalysis, FrameTiming, Stall, StereoBufferUse, StreamBytes, UnitTiming
from arch.technology import Technology

__all__ = [
    "COUNTERS",
    "AcceleratorConfig",
    "Activity",
    "AreaPart",
    "AreaReport",
    "ClientWork",
    "CostTable",
    "Count",
    "EnergyPart",
    "EnergyReport",
    "FrameAnalysis",
    "FrameTiming",
    "PaperFigure",
    "SourcedGroup",
    "Stall",
    "StereoBufferUse",
    "StreamBytes",
    "Technology",
    "UnitTiming",
    "analyse_frame",
    "area",
    "frame_energy",
    "paper_comparison",
    "sourced_groups",
    "with_cores",
]
