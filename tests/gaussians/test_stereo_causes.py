"""Every deviation from `exact` is one cause; methods between have the causes they are said to."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gaussians.stereo_causes import CAUSE_NAMES, CAUSES, causes_of, isolated, keeping, ladder
from gaussians.stereo_method import PRESETS, StereoMethod, parse_method
from tests.gaussians.test_stereo_method import any_method

PAPER, EXACT = PRESETS["paper"], PRESETS["exact"]
SUBSETS = st.sets(st.sampled_from(CAUSE_NAMES))


def with_implied(causes: set[str]) -> set[str]:
    """A splat that is sent where its disparity points ignores the right footprint."""
    return causes | ({"footprint"} if "insertion" in causes else set())


def switches(method: StereoMethod) -> StereoMethod:
    """The method without its name."""
    return replace(method, name="")


def test_causes_are_numbered_one_to_ten() -> None:
    numerals = ["i", "ii", "iii", "iv", "v", "vi", "vii", "viii", "ix", "x"]
    assert [cause.numeral for cause in CAUSES] == numerals
    assert len(set(CAUSE_NAMES)) == 10 and all(cause.description for cause in CAUSES)


def test_presets_have_all_causes_or_none() -> None:
    assert causes_of(PAPER) == CAUSE_NAMES
    assert causes_of(EXACT) == causes_of(PRESETS["independent"]) == ()
    assert causes_of(parse_method("independent,intersection=square_3sigma")) == ("footprint",)


@pytest.mark.parametrize(
    ("text", "causes"),
    [
        ("exact,conic=left", {"conic"}),
        ("exact,colour=left", {"colour"}),
        ("exact,centre=shifted", {"centre"}),
        ("exact,out_of_range=drop", {"rows"}),
        ("exact,left_view=image", {"left_view"}),
        ("exact,tie=depth", {"ties"}),
        ("exact,intersection=obb", {"footprint"}),
        ("exact,forwarding=live_list", {"termination"}),
        ("exact,forwarding=alpha_pass", {"alpha_check"}),
        ("exact,forwarding=live_alpha_pass", {"termination", "alpha_check"}),
        ("paper,conic=per_eye", set(CAUSE_NAMES) - {"conic"}),
        ("paper,colour=per_eye,centre=projected", set(CAUSE_NAMES) - {"colour", "centre"}),
        ("paper,out_of_range=spill", set(CAUSE_NAMES) - {"rows"}),
        ("paper,left_view=widened", set(CAUSE_NAMES) - {"left_view"}),
        ("paper,insertion=two_tiles", set(CAUSE_NAMES) - {"insertion"}),
        ("paper,insertion=round", set(CAUSE_NAMES)),
        ("paper,forwarding=list", set(CAUSE_NAMES) - {"termination", "alpha_check"}),
        # what costs work, but no bits
        ("exact,rows=1", set()),
        ("exact,out_of_range=spill", set()),
        ("exact,out_of_range=independent_tile", set()),
        ("exact,left_view=widened", set()),
        ("exact,independent_edge_tiles=3", set()),
    ],
)
def test_a_switch_brings_the_cause_it_stands_for(text: str, causes: set[str]) -> None:
    assert set(causes_of(parse_method(text))) == causes


def test_the_ladder_climbs_from_paper_to_exact_by_one_cause_a_rung() -> None:
    rungs = ladder()
    assert rungs[0] == PAPER and rungs[-1] == EXACT
    present = [set(causes_of(rung)) for rung in rungs]
    assert len(present[0]) == 10 and not present[-1]
    mended: list[str] = []
    for rung, before, after in zip(rungs[1:], present, present[1:], strict=False):
        if rung.name == "paper+ellipse":  # half a fix: the right footprint is still ignored
            assert before == after == {"footprint"} and rung.intersection == "ellipse"
            continue
        assert after < before and len(before - after) == 1
        mended += before - after
        assert rung.name in (f"paper+{mended[-1]}", "exact")
    assert sorted(mended) == sorted(CAUSE_NAMES) and mended[-1] == "footprint"
    assert len({switches(rung) for rung in rungs}) == len(rungs) == 12
    assert len({rung.name for rung in rungs}) == 12


def test_isolated_methods_have_one_cause_each() -> None:
    paper, *single, exact = isolated()
    assert (paper, exact) == (PAPER, EXACT)
    assert [method.name for method in single] == [f"exact-{name}" for name in CAUSE_NAMES]
    for method, name in zip(single, CAUSE_NAMES, strict=True):
        assert set(causes_of(method)) == with_implied({name})
    for one, two in combinations(single, 2):
        assert switches(one) != switches(two)


def test_keeping_every_cause_or_none_is_the_method_or_exact() -> None:
    assert keeping(PAPER, CAUSE_NAMES, "paper") == PAPER
    assert keeping(PAPER, (), "exact") == EXACT
    assert keeping(EXACT, CAUSE_NAMES, "exact") == EXACT


@given(SUBSETS)
def test_what_is_kept_is_there_and_nothing_else(causes: set[str]) -> None:
    kept = keeping(PAPER, causes, "between")
    assert set(causes_of(kept)) == with_implied(causes) and kept.name == "between"
    assert keeping(kept, CAUSE_NAMES, "between") == kept


@given(any_method(), SUBSETS)
def test_keeping_never_adds_a_cause(method: StereoMethod, causes: set[str]) -> None:
    if method.forwarding == "none":
        return
    kept = keeping(method, causes, "")
    assert set(causes_of(kept)) == with_implied(causes & set(causes_of(method)))
    assert kept.rows == method.rows
    # boxes hold every tile of the ellipse, so they are no deviation and stay
    lists = "box" if method.intersection == "box" else "ellipse"
    mended = replace(EXACT, name="", rows=method.rows, intersection=lists)
    assert switches(keeping(method, (), "")) == mended
    assert keeping(method, sorted(causes), "") == kept
