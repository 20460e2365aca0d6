"""How the right eye is made from the left one, as data: a stereo method is a set of switches.

The preset ``paper`` is the method of Sec. 4.4 and Sec. 5 as written, ``exact`` the carrier rule
(docs/stereo.md), ``independent`` the reference that shares nothing. Every other combination is
somewhere between, and ``parse_method`` reads one from text.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

from gaussians.errors import InputError
from gaussians.footprints import INTERSECTIONS, Intersection

Forwarding = Literal["none", "live_alpha_pass", "alpha_pass", "live_list", "list"]
Insertion = Literal["floor", "round", "two_tiles", "right_span", "carrier"]
OutOfRange = Literal["drop", "spill", "independent_tile", "forward_only"]
LeftView = Literal["image", "widened", "forward_only"]
PerEye = Literal["per_eye", "left"]
Centre = Literal["projected", "shifted"]
Tie = Literal["id", "depth"]


@dataclass(frozen=True)
class StereoMethod:
    """The switches of a stereo method. All others are idle where ``forwarding`` is none.

    Parameters
    ----------
    forwarding : which entries of a left tile's list go to the right eye. ``none``: none, the right
        eye bins for itself. ``live_alpha_pass``: what passes in a pixel that has not stopped.
        ``alpha_pass``: what passes in any pixel, also after the tile has terminated.
        ``live_list``: every entry until the tile terminates. ``list``: every entry.
    insertion : into which right tiles. By disparity d in tiles: ``floor`` and ``round`` (half up)
        into one, ``two_tiles`` into both that the shifted tile touches. By the right eye's own
        footprint: ``right_span``, each tile of it from the left list entry nearest to t + ceil(d);
        ``carrier`` the same, and where no left list holds the splat, binning adds a forward-only
        entry.
    intersection : footprint both eyes are binned by, see footprints.py
    rows : K, rows of the stereo buffer; row k takes what moves left by k tiles
    out_of_range : what becomes of a forward that finds no row. ``drop``: lost. ``spill``: goes
        through memory, in order. ``independent_tile``: the right tile is binned on its own.
        ``forward_only``: binning adds an entry to the nearest left tile that has a row.
    conic, colour : of the right eye, its own or the left one's
    centre : of the right eye, projected or u_left - B f / z
    left_view : left tiles that forward. ``image``: those of the left image. ``widened``: those of
        a virtual camera behind both eyes, which sees all that either eye sees. ``forward_only``:
        those of the image, the last of which stands in for what lies beyond it.
    independent_edge_tiles : last right tile columns, binned on their own
    tie : what the merge unit compares. ``id``: depth, then id, as everywhere. ``depth``: depth
        alone; of equal depths the lower row goes first.

    Raises
    ------
    InputError : a switch has none of its values, or two of them contradict each other
    """

    name: str
    forwarding: Forwarding
    insertion: Insertion = "carrier"
    intersection: Intersection = "ellipse"
    rows: int = 4
    out_of_range: OutOfRange = "forward_only"
    conic: PerEye = "per_eye"
    colour: PerEye = "per_eye"
    centre: Centre = "projected"
    left_view: LeftView = "forward_only"
    independent_edge_tiles: int = 0
    tie: Tie = "id"

    def __post_init__(self) -> None:
        for field, allowed in _CHOICES.items():
            if getattr(self, field) not in allowed:
                raise InputError(
                    f"stereo method: {field} must be one of {', '.join(allowed)}, "
                    f"not {getattr(self, field)!r}"
                )
        if not 1 <= self.rows <= 1024:
            raise InputError(f"stereo method: rows must lie in 1..1024, not {self.rows}")
        if not 0 <= self.independent_edge_tiles <= 1024:
            raise InputError(
                "stereo method: independent_edge_tiles must lie in 0..1024, "
                f"not {self.independent_edge_tiles}"
            )
        for field in ("out_of_range", "left_view"):
            if getattr(self, field) == "forward_only" and self.insertion != "carrier":
                raise InputError(
                    f"stereo method: {field} forward_only needs insertion carrier, "
                    f"not {self.insertion}"
                )

    @property
    def walks_past_termination(self) -> bool:
        """Left lists are read to their end for the SRU, whatever the left pixels still need."""
        return self.forwarding in ("alpha_pass", "list")

    @property
    def stops_with_left_tile(self) -> bool:
        """What lies behind the left tile's last live pixel is not forwarded."""
        return self.forwarding in ("live_alpha_pass", "live_list")

    @property
    def by_disparity(self) -> bool:
        """The right footprint is not asked for."""
        return self.insertion in ("floor", "round", "two_tiles")

    def __str__(self) -> str:
        if self.forwarding == "none":
            return f"{self.name}: both eyes binned independently, {self.intersection} lists"
        edge = self.independent_edge_tiles
        return (
            f"{self.name}: forward {self.forwarding}, insert {self.insertion}, {self.rows} rows, "
            f"out of range {self.out_of_range}, {self.intersection} lists, conic {self.conic}, "
            f"colour {self.colour}, centre {self.centre}, left view {self.left_view}"
            f"{f' and {edge} independent edge tiles' if edge else ''}, tie by {self.tie}"
        )


_CHOICES: dict[str, tuple[str, ...]] = {
    "forwarding": get_args(Forwarding),
    "insertion": get_args(Insertion),
    "intersection": INTERSECTIONS,
    "out_of_range": get_args(OutOfRange),
    "conic": get_args(PerEye),
    "colour": get_args(PerEye),
    "centre": get_args(Centre),
    "left_view": get_args(LeftView),
    "tie": get_args(Tie),
}

PRESETS = {
    "independent": StereoMethod("independent", "none"),
    # Sec. 4.4: a Gaussian that "passes an alpha-check" goes to "one of four lists" by its
    # disparity; Sec. 5: the line buffer's first three right tiles are rendered independently,
    # which with a right image that moves left are its last three.
    "paper": StereoMethod(
        "paper",
        "live_alpha_pass",
        insertion="floor",
        intersection="square_3sigma",
        out_of_range="drop",
        conic="left",
        colour="left",
        centre="shifted",
        left_view="image",
        independent_edge_tiles=3,
        tie="depth",
    ),
    "exact": StereoMethod("exact", "list"),
}


def parse_method(text: str) -> StereoMethod:
    """A method from ``PRESET`` or ``PRESET,switch=value,...``, such as ``paper,rows=8``.

    Raises InputError for an unknown preset, switch or value.
    """
    preset, *changes = text.split(",")
    if preset not in PRESETS:
        raise InputError(f"method must be one of {', '.join(PRESETS)}, not {preset!r}")
    values: dict[str, Any] = {}
    switches = [field.name for field in fields(StereoMethod) if field.name != "name"]
    for change in changes:
        switch, _, value = change.partition("=")
        if switch not in switches or not value:
            raise InputError(
                f"method {preset}: {change!r} must be SWITCH=VALUE with one of the switches "
                f"{', '.join(switches)}"
            )
        if switch in values:
            raise InputError(f"method {preset}: {switch} is given twice")
        values[switch] = value if switch in _CHOICES else _count(switch, value)
    return replace(PRESETS[preset], name=text, **values)


def _count(switch: str, value: str) -> int:
    try:
        return int(value)
    except ValueError:
        raise InputError(f"method: {switch} must be an integer, not {value!r}") from None
