"""The ten ways in which a stereo method can miss the right eye's bits, each a switch of its own.

A cause is present in a method where giving up all the other deviations from ``exact`` still leaves
one. ``keeping`` builds the methods between: those causes kept, all others mended.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from gaussians.stereo_method import PRESETS, Forwarding, Insertion, StereoMethod


@dataclass(frozen=True)
class Cause:
    """One deviation from the exact right eye."""

    name: str
    numeral: str
    description: str


CAUSES = (
    Cause("termination", "i", "a left tile that terminates hides what the right eye still sees"),
    Cause("alpha_check", "ii", "the check at left pixel centres is not the one at right ones"),
    Cause("insertion", "iii", "a shifted tile touches two right tiles, the splat enters one"),
    Cause("conic", "iv", "the left eye's conic is reused"),
    Cause("colour", "v", "the left eye's view-dependent colour is reused"),
    Cause("rows", "vi", "the disparity exceeds the rows of the stereo buffer"),
    Cause("left_view", "vii", "the splat lies outside the left eye's view"),
    Cause("ties", "viii", "equal depths are merged in the order of their rows"),
    Cause("footprint", "ix", "loose three-sigma lists, and the right footprint is ignored"),
    Cause("centre", "x", "u_left - B f / z rounds differently from projecting"),
)
CAUSE_NAMES = tuple(cause.name for cause in CAUSES)

# Cumulative fixes of `verify --ladder`, from the cheapest to the carrier rule.
LADDER = (
    *("colour", "centre", "conic", "insertion", "rows", "left_view"),
    *("termination", "alpha_check", "ties", "footprint"),
)


def keeping(method: StereoMethod, causes: Collection[str], name: str) -> StereoMethod:
    """``method`` with these of its causes, and with every other one mended as ``exact`` does it."""
    live = "termination" in causes and method.stops_with_left_tile
    checked = "alpha_check" in causes and method.forwarding in ("live_alpha_pass", "alpha_pass")
    passes: Forwarding = "live_alpha_pass" if live else "alpha_pass"
    entries: Forwarding = "live_list" if live else "list"
    insertion: Insertion = "carrier"
    if "footprint" in causes:
        insertion = "two_tiles" if method.by_disparity else method.insertion
    if "insertion" in causes and method.insertion in ("floor", "round"):
        insertion = method.insertion
    loose = "footprint" in causes  # a box that holds the ellipse is not
    carried = insertion == "carrier"
    ranged = "rows" in causes and method.out_of_range == "drop"
    hidden = "left_view" in causes and method.left_view == "image"
    return replace(
        PRESETS["exact"],
        name=name,
        forwarding=passes if checked else entries,
        insertion=insertion,
        intersection=method.intersection if loose or method.intersection == "box" else "ellipse",
        rows=method.rows,
        out_of_range="drop" if ranged else "forward_only" if carried else "spill",
        conic=method.conic if "conic" in causes else "per_eye",
        colour=method.colour if "colour" in causes else "per_eye",
        centre=method.centre if "centre" in causes else "projected",
        left_view="image" if hidden else "forward_only" if carried else "widened",
        independent_edge_tiles=method.independent_edge_tiles if hidden else 0,
        tie=method.tie if "ties" in causes else "id",
    )


def causes_of(method: StereoMethod) -> tuple[str, ...]:
    """Names of the causes present in ``method``; none for `independent` and `exact`."""
    if method.forwarding == "none":
        return () if method.intersection in ("ellipse", "box") else ("footprint",)
    exact = keeping(method, (), "")
    return tuple(cause for cause in CAUSE_NAMES if keeping(method, (cause,), "") != exact)


def ladder() -> tuple[StereoMethod, ...]:
    """`paper`, then one fix after the other, at last `exact`."""
    paper = PRESETS["paper"]
    rungs, left = [paper], list(LADDER)
    for cause in LADDER[:-1]:
        left.remove(cause)
        rungs.append(keeping(paper, left, f"paper+{cause}"))
    ellipse = replace(rungs[-1], name="paper+ellipse", intersection="ellipse")
    return (*rungs, ellipse, PRESETS["exact"])


def isolated() -> tuple[StereoMethod, ...]:
    """`paper`, then `exact` with one of its causes at a time, at last `exact`."""
    paper = PRESETS["paper"]
    single = [keeping(paper, (name,), f"exact-{name}") for name in CAUSE_NAMES]
    return (paper, *single, PRESETS["exact"])
