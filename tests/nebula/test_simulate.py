"""The main job on small cities: exactness, equal bits, and that failure leaves nothing behind."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gaussians import parallel
from gaussians.cameras import Display
from gaussians.errors import InputError
from nebula.options import GeneratedCity, SceneOptions, SimulateOptions
from nebula.report import stable_part, validate_report
from nebula.simulate import run
from tests.gaussians.real_data import data_file

SMALL = ["--city-leaves", "1000", "--width", "40", "--height", "32", "--frames", "5"]
FILES = ["difference.png", "left.png", "report.html", "report.json", "right.png"]


def options(out: Path, **changes) -> SimulateOptions:
    scene = SceneOptions(
        scene=GeneratedCity(5000),
        level=None,
        up=None,
        units_per_metre=1.0,
        view=changes.pop("view", None),
        near_m=0.2,
        display=Display.from_fov(96, 80, 96.0),
        trace=changes.pop("trace", "walk"),
    )
    values = {
        "scene": scene,
        "seed": 3,
        "frames": 6,
        "method": None,
        "tau_px": 6.0,
        "search_every": 2,
        "accelerator": "nebula",
        "rate_mbps": 100.0,
        "latency_ms": 5.0,
        "baseline_m": 0.06,
        "trace_fov": False,
        "out": out,
        "html": True,
    }
    return SimulateOptions(**(values | changes))


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("plain")
    return run(options(out)).data, out


def test_a_run_writes_a_valid_report_page_and_images(plain):
    report, out = plain
    assert sorted(p.name for p in out.iterdir()) == FILES
    assert json.loads((out / "report.json").read_text()) == report
    validate_report(report)
    assert report["stereo"]["covered_pixels_share"]["left"] > 0.99
    assert report["lod"]["nodes"] == 2 * 5000 - 1


def test_the_right_eye_is_exact_and_the_counters_say_what_it_took(plain):
    report, _ = plain
    stereo = report["stereo"]
    assert stereo["method"] == "exact" and stereo["psnr_db"] is None
    assert stereo["right_mismatching_pixels"] == 0 == stereo["right_mismatching_pixels_8bit"]
    assert stereo["pixels"] == 6 * 96 * 80
    assert stereo["duplicates"] == 0 < stereo["row_writes_per_entry"]


def test_messages_arrive_after_latency_and_computing_time(plain):
    """5 ms up, 5 ms cloud, 5 ms down: shown two frames (22 ms) after the pose, not earlier."""
    report, _ = plain
    sent = report["stream"]["message_bytes"]
    received = [frame["message_bytes"] for frame in report["frames"]]
    assert len(sent) == 3
    assert received == [0, 0, 0, 0, sent[1], 0]


def test_slow_links_deliver_later(tmp_path):
    report = run(options(tmp_path, latency_ms=20.0)).data
    sent = report["stream"]["message_bytes"]
    assert [f["message_bytes"] for f in report["frames"]][4:] == [0, 0]
    assert len(sent) == 3


def test_what_is_decoded_is_close_to_the_cut_and_the_cut_to_the_leaves(plain):
    quality = plain[0]["quality"]
    assert quality["frames"] == [0, 5]
    assert quality["decoded_vs_cut"]["psnr_db"] > 40
    assert quality["cut_vs_leaves"]["psnr_db"] > 30
    assert 0.99 < quality["decoded_vs_cut"]["ssim"] <= 1


def test_paper_method_is_not_exact_and_says_so(tmp_path):
    stereo = run(options(tmp_path, method="paper", baseline_m=2.0)).data["stereo"]
    assert stereo["right_mismatching_pixels"] > 0.5 * stereo["pixels"]
    assert stereo["right_mismatching_pixels_8bit"] > 1000
    assert stereo["dropped"] > 0 and stereo["psnr_db"] < 40


def test_gscore_renders_independent_eyes_from_its_own_lists(tmp_path):
    report = run(options(tmp_path, accelerator="gscore_nebula")).data
    assert report["stereo"]["method"] == "independent"
    assert "obb" in report["stereo"]["description"]
    # what its three-sigma boxes cut off: judged against ellipse lists, as every method is
    assert report["stereo"]["right_mismatching_pixels"] > 0
    assert report["stereo"]["psnr_db"] > 50
    assert "stereo_reprojection_unit" not in report["area"]["parts"]


def test_gscore_refuses_a_stereo_method_it_has_no_units_for(tmp_path):
    with pytest.raises(InputError, match="has no stereo units"):
        run(options(tmp_path / "new", accelerator="gscore_nebula", method="exact"))
    assert not (tmp_path / "new").exists()


def test_a_view_that_sees_nothing_is_an_error_and_writes_nothing(tmp_path):
    (tmp_path / "left.png").write_text("old")
    with pytest.raises(InputError, match="frame 0: no splat is visible"):
        run(options(tmp_path, view="0,0,900:0,100,1800"))
    assert [p.name for p in tmp_path.iterdir()] == ["left.png"]
    assert (tmp_path / "left.png").read_text() == "old"


def test_one_and_two_threads_give_the_same_bits(tmp_path, plain):
    before = parallel.threads()
    try:
        parallel.set_threads(1 if before > 1 else 2)
        again = run(options(tmp_path)).data
    finally:
        parallel.set_threads(before)
    assert stable_part(again) == stable_part(plain[0])
    for name in ("left.png", "right.png"):
        assert (tmp_path / name).read_bytes() == (plain[1] / name).read_bytes()


@pytest.mark.real_data
def test_off_axis_windows_of_a_recording_are_exact_too(tmp_path):
    trace = str(data_file("traces/eyenavgs/user110_london.csv"))
    report = run(options(tmp_path, trace=trace, trace_fov=True)).data
    display = report["provenance"]["display"]
    assert display["cx_left"] - display["cx_right"] in (16, 32)  # 23 px before rounding
    assert report["stereo"]["right_mismatching_pixels"] == 0
    assert any("turns each window by" in note for note in report["notes"])


def test_generated_traces_have_no_half_angles(tmp_path):
    with pytest.raises(InputError, match="--trace-fov: trace walk must be a recording"):
        run(options(tmp_path, trace_fov=True))


def test_another_seed_gives_another_run(tmp_path, plain):
    other = run(dataclasses.replace(options(tmp_path), seed=4)).data
    assert stable_part(other)["frames"] != stable_part(plain[0])["frames"]


def test_compiled_and_interpreted_kernels_give_the_same_bits(tmp_path):
    """The whole line with and without numba's compiler."""
    command = [sys.executable, "-m", "nebula", "simulate", *SMALL, "--no-html", "--out"]
    for name, disable in (("jit", "0"), ("nojit", "1")):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disable}
        subprocess.run(
            [*command, str(tmp_path / name)], check=True, capture_output=True, env=environment
        )
    reports = [
        json.loads((tmp_path / name / "report.json").read_text()) for name in ("jit", "nojit")
    ]
    assert stable_part(reports[0]) == stable_part(reports[1])
    for name in ("left.png", "right.png"):
        images = [(tmp_path / kind / name).read_bytes() for kind in ("jit", "nojit")]
        assert images[0] == images[1]


def test_paced_messages_stay_within_the_link(plain, tmp_path):
    """A slow link brings the first picture in parts; the report says what was pending."""
    paced = run(options(tmp_path, paced=True, rate_mbps=8.0, frames=8)).data
    pacing, stream = paced["stream"]["pacing"], paced["stream"]
    assert plain[0]["stream"]["pacing"] == {}
    assert pacing["budget_bytes"] == int(2 / 90 * 1e6)
    assert (
        max(stream["message_bytes"]) <= pacing["budget_bytes"] < plain[0]["stream"]["initial_bytes"]
    )
    assert len(pacing["pending_nodes"]) == len(pacing["tau_px"]) == 4
    assert pacing["pending_nodes"][0] > 0 and pacing["deferred_bytes"][0] > 0
    assert "nodes pending, most" in (tmp_path / "report.html").read_text(encoding="utf-8")
