"""A stereo method refuses what contradicts itself, names itself in one line, and is read back."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from itertools import combinations
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.footprints import INTERSECTIONS
from gaussians.stereo_causes import isolated, ladder
from gaussians.stereo_method import PRESETS, StereoMethod, parse_method

EXACT, PAPER, INDEPENDENT = (PRESETS[name] for name in ("exact", "paper", "independent"))
VALUES: dict[str, tuple[Any, ...]] = {
    "forwarding": ("none", "live_alpha_pass", "alpha_pass", "live_list", "list"),
    "insertion": ("floor", "round", "two_tiles", "right_span", "carrier"),
    "intersection": INTERSECTIONS,
    "rows": (1, 2, 4, 1024),
    "out_of_range": ("drop", "spill", "independent_tile", "forward_only"),
    "conic": ("per_eye", "left"),
    "colour": ("per_eye", "left"),
    "centre": ("projected", "shifted"),
    "left_view": ("image", "widened", "forward_only"),
    "independent_edge_tiles": (0, 3, 1024),
    "tie": ("id", "depth"),
}


def test_these_are_all_switches() -> None:
    assert ["name", *VALUES] == [field.name for field in fields(StereoMethod)]


@st.composite
def any_method(draw: st.DrawFn) -> StereoMethod:
    values = {switch: draw(st.sampled_from(allowed)) for switch, allowed in VALUES.items()}
    if values["insertion"] != "carrier":
        for switch in ("out_of_range", "left_view"):
            values[switch] = draw(st.sampled_from(VALUES[switch][:-1]))
    return StereoMethod("drawn", **values)


def changed(method: StereoMethod, **switches: Any) -> StereoMethod:
    """With values that may be none of the switch's."""
    return replace(method, **switches)


def refused(text: str) -> Any:
    return pytest.raises(InputError, match=re.escape(text))


@pytest.mark.parametrize("switch", [s for s in VALUES if isinstance(VALUES[s][0], str)])
@pytest.mark.parametrize("value", ["", "None", "LIST", "spil", None])
def test_a_value_no_switch_has_is_refused(switch: str, value: Any) -> None:
    allowed = ", ".join(VALUES[switch])
    with refused(f"stereo method: {switch} must be one of {allowed}, not {value!r}"):
        changed(EXACT, **{switch: value})


@pytest.mark.parametrize(
    ("switch", "value", "message"),
    [
        ("rows", 0, "rows must lie in 1..1024, not 0"),
        ("rows", -1, "rows must lie in 1..1024, not -1"),
        ("rows", 1025, "rows must lie in 1..1024, not 1025"),
        ("independent_edge_tiles", -1, "independent_edge_tiles must lie in 0..1024, not -1"),
        ("independent_edge_tiles", 1025, "independent_edge_tiles must lie in 0..1024, not 1025"),
    ],
)
def test_a_count_out_of_its_range_is_refused(switch: str, value: int, message: str) -> None:
    with refused(f"stereo method: {message}"):
        changed(EXACT, **{switch: value})


@pytest.mark.parametrize("insertion", VALUES["insertion"][:-1])
@pytest.mark.parametrize("switch", ["out_of_range", "left_view"])
def test_entries_added_by_binning_need_the_carrier_rule(insertion: str, switch: str) -> None:
    valid = changed(EXACT, insertion=insertion, out_of_range="drop", left_view="image")
    message = f"stereo method: {switch} forward_only needs insertion carrier, not {insertion}"
    with refused(message):
        changed(valid, **{switch: "forward_only"})
    assert changed(valid, insertion="carrier", **{switch: "forward_only"})


@given(any_method(), any_method())
def test_a_method_names_itself_in_one_line_of_its_own(one: StereoMethod, two: StereoMethod) -> None:
    text = str(one)
    assert text.startswith("drawn: ") and text.isprintable() and len(text) < 400
    if one.forwarding == "none":
        assert one.intersection in text and "independently" in text
        return
    for switch, value in vars(one).items():
        assert str(value) in text or (switch, value) == ("independent_edge_tiles", 0)
    assert (text == str(two)) == (one == two)


@given(any_method(), st.sampled_from(list(VALUES)), st.data())
def test_one_switch_is_enough_to_tell_methods_apart(
    one: StereoMethod, switch: str, data: st.DataObject
) -> None:
    try:
        two = changed(one, **{switch: data.draw(st.sampled_from(VALUES[switch]))})
    except InputError:
        return
    idle = one.forwarding == two.forwarding == "none" and switch != "intersection"
    assert (str(one) == str(two)) == (one == two or idle)


def test_named_methods_read_differently_but_for_their_names() -> None:
    named = [replace(method, name="") for method in (*ladder(), *isolated(), *PRESETS.values())]
    for one, two in combinations(named, 2):
        assert (str(one) == str(two)) == (one == two)


def test_presets_are_what_they_say() -> None:
    assert str(INDEPENDENT) == "independent: both eyes binned independently, ellipse lists"
    assert str(PAPER) == (
        "paper: forward live_alpha_pass, insert floor, 4 rows, out of range drop, square_3sigma "
        "lists, conic left, colour left, centre shifted, left view image and 3 independent edge "
        "tiles, tie by depth"
    )
    assert str(EXACT) == (
        "exact: forward list, insert carrier, 4 rows, out of range forward_only, ellipse lists, "
        "conic per_eye, colour per_eye, centre projected, left view forward_only, tie by id"
    )
    assert all(PRESETS[name].name == name for name in PRESETS)


@given(any_method())
def test_forwarding_either_stops_with_the_left_tile_or_walks_past_its_end(
    method: StereoMethod,
) -> None:
    live = method.forwarding.startswith("live")
    assert method.stops_with_left_tile == live
    assert method.walks_past_termination == (not live and method.forwarding != "none")
    assert method.by_disparity == (method.insertion not in ("right_span", "carrier"))


@given(any_method(), st.sampled_from(list(PRESETS)))
def test_a_method_written_as_text_is_read_back(method: StereoMethod, preset: str) -> None:
    changes = {k: v for k, v in vars(method).items() if k != "name"}
    text = ",".join([preset, *(f"{switch}={value}" for switch, value in changes.items())])
    assert parse_method(text) == replace(method, name=text)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_alone_is_the_preset(preset: str) -> None:
    assert parse_method(preset) == PRESETS[preset]


def test_what_is_not_given_stays_as_in_the_preset() -> None:
    text = "paper,rows=8,conic=per_eye"
    assert parse_method(text) == replace(PAPER, name=text, rows=8, conic="per_eye")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "method must be one of independent, paper, exact, not ''"),
        ("best", "method must be one of independent, paper, exact, not 'best'"),
        ("rows=4", "method must be one of independent, paper, exact, not 'rows=4'"),
        ("paper,", "method paper: '' must be SWITCH=VALUE with one of the switches forwarding, "),
        ("paper,rows", "method paper: 'rows' must be SWITCH=VALUE with one of the switches"),
        ("paper,rows=", "method paper: 'rows=' must be SWITCH=VALUE with one of the switches"),
        ("paper,row=4", "method paper: 'row=4' must be SWITCH=VALUE with one of the switches"),
        ("paper,name=x", "method paper: 'name=x' must be SWITCH=VALUE with one of the switches"),
        ("paper, rows=4", "method paper: ' rows=4' must be SWITCH=VALUE"),
        ("paper,rows=4,rows=8", "method paper: rows is given twice"),
        ("paper,rows=four", "method: rows must be an integer, not 'four'"),
        ("paper,rows=4.0", "method: rows must be an integer, not '4.0'"),
        ("paper,rows=0", "stereo method: rows must lie in 1..1024, not 0"),
        ("paper,tie=both", "stereo method: tie must be one of id, depth, not 'both'"),
        ("paper,left_view=forward_only", "left_view forward_only needs insertion carrier"),
        ("exact,insertion=floor", "out_of_range forward_only needs insertion carrier, not floor"),
    ],
)
def test_text_that_is_no_method_is_refused(text: str, message: str) -> None:
    with refused(message) as caught:
        parse_method(text)
    assert "\n" not in str(caught.value)
