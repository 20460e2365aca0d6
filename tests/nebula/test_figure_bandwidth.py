"""H.265 of a tiny clip, and the figure that sets it against the stream."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from gaussians.cameras import DISPLAYS
from gaussians.errors import InputError
from gaussians.parallel import set_threads, threads
from nebula import figure
from nebula.figures import bandwidth
from nebula.figures.bandwidth import MeanError, shrunk
from nebula.figures.video import QUALITIES, VideoQuality, require_av, transcode
from tests.nebula.small_trees import figure_options, small_street

needs_av = pytest.mark.skipif(
    find_spec("av") is None, reason="needs PyAV: pip install 'nebula-splat[video]'"
)


def clip(frames: int = 5) -> list[np.ndarray]:
    """Smooth coloured waves that move by two pixels per frame."""
    y, x = np.mgrid[0:48, 0:64]
    waves = [
        np.stack(
            [
                127 + 100 * np.sin((x + 2 * n) / 5),
                127 + 100 * np.cos((y + x + n) / 7),
                127 + 60 * np.sin((x - n) * y / 90),
            ],
            axis=2,
        )
        for n in range(frames)
    ]
    return [np.rint(wave).astype(np.uint8) for wave in waves]


@needs_av
def test_lossless_rgb_gives_back_every_bit():
    frames = [np.random.default_rng(7).integers(0, 256, (48, 64, 3), np.uint8) for _ in range(3)]
    coded = transcode(frames, QUALITIES[0], 90.0)
    assert QUALITIES[0].pixel_format == "gbrp" and QUALITIES[0].crf is None
    for sent, shown in zip(frames, coded.frames, strict=True):
        assert np.array_equal(sent, shown)


@needs_av
def test_a_lower_rate_factor_is_better_and_larger():
    frames, psnr, sizes = clip(), [], []
    for quality in QUALITIES[1:]:
        coded = transcode(frames, quality, 90.0)
        error = MeanError()
        for sent, shown in zip(frames, coded.frames, strict=True):
            error.add(shown, sent)
        psnr.append(error.psnr_db)
        sizes.append(sum(map(len, coded.packets)))
    assert psnr == sorted(psnr, reverse=True) and sizes == sorted(sizes, reverse=True)
    assert psnr[0] > psnr[-1] + 1 and psnr[-1] > 20


@needs_av
def test_colours_survive_the_conversion():
    for colour in ((0, 0, 0), (255, 255, 255), (90, 90, 90), (200, 50, 30), (10, 180, 220)):
        plain = [np.full((32, 32, 3), colour, np.uint8)] * 2
        shown = transcode(plain, VideoQuality("4:2:0", None), 90.0).frames[1]
        assert np.abs(shown.astype(int) - colour).max() <= 2


@needs_av
def test_one_i_frame_then_p_frames_and_bits_are_those_of_packets():
    import av
    from av.video.frame import PictureType

    coded = transcode(clip(), QUALITIES[2], 90.0)
    decoder = av.CodecContext.create("hevc", "r")
    kinds = [f.pict_type for p in coded.packets for f in decoder.decode(av.Packet(p))]
    kinds += [frame.pict_type for frame in decoder.decode(None)]
    assert [PictureType(kind).name for kind in kinds] == ["I", "P", "P", "P", "P"]
    assert coded.first_bytes == len(coded.packets[0])
    bits = 8 * sum(len(packet) for packet in coded.packets[1:])
    assert coded.steady_mbps(90.0) == pytest.approx(bits / 4 * 90 / 1e6)


@needs_av
def test_bits_do_not_depend_on_threads():
    before = threads()
    try:
        coded = []
        for count in (1, 3):
            set_threads(count)
            coded.append(transcode(clip(), QUALITIES[3], 90.0).packets)
    finally:
        set_threads(before)
    assert coded[0] == coded[1]


@needs_av
def test_what_cannot_be_coded_is_refused():
    with pytest.raises(InputError, match="at least 2 frames, not 1"):
        transcode(clip(1), QUALITIES[0], 90.0)
    odd = [np.zeros((48, 63, 3), np.uint8)] * 2
    with pytest.raises(InputError, match="width and height must be even, not 63 x 48"):
        transcode(odd, QUALITIES[1], 90.0)


def test_without_av_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install 'nebula-splat\[video\]'"):
        require_av()


def test_pictures_are_smaller_with_the_same_field_of_view():
    full = DISPLAYS["prototype"]
    small = shrunk(full, 4)
    assert (small.width, small.height) == (516, 552) and shrunk(full, 1) == full
    assert small.width / small.fx == pytest.approx(full.width / full.fx)
    assert small.cx_left / small.fx == pytest.approx(full.cx_left / full.fx)
    with pytest.raises(InputError, match="--shrink 500: pictures must keep 16 pixels"):
        shrunk(full, 500)


def test_mean_error_is_of_all_pictures():
    black, grey = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 51, np.uint8)
    error = MeanError()
    assert error.psnr_db is None
    error.add(black, black)
    assert error.psnr_db is None
    error.add(grey, black)
    assert error.psnr_db == pytest.approx(-10 * np.log10(0.2**2 / 2), abs=1e-5)


@pytest.fixture(scope="module")
def asked(tmp_path_factory: Any) -> Any:
    """Options of the figure on a small tree."""
    tree = small_street(tmp_path_factory.mktemp("trees") / "small_street")
    out = tmp_path_factory.mktemp("figure")

    def ask(**changes: Any) -> Any:
        return figure_options("bandwidth", out, tree, **{"frames": 6, "shrink": 1, **changes})

    return ask


@needs_av
def test_video_and_stream_are_judged_by_the_same_pictures(asked):
    data = figure.run(asked()).data
    rows = {(row["trace"], row["coding"]): row for row in data["rows"]}
    codings = [quality.name for quality in QUALITIES]
    assert len(rows) == len(data["rows"])
    for trace in ("stand", "walk", "flight"):
        own = {coding: row for (name, coding), row in rows.items() if name == trace}
        assert list(own)[: len(codings)] == codings
        lossless, low, stream = own["lossless RGB"], own["low, CRF 24"], own["Δcut, paper"]
        assert lossless["psnr_vs_cut_db"] is None
        assert lossless["psnr_vs_leaves_db"] == lossless["cut_psnr_vs_leaves_db"]
        assert lossless["mbps"] > own["high, CRF 12"]["mbps"] > low["mbps"]
        assert own["high, CRF 12"]["psnr_vs_cut_db"] > low["psnr_vs_cut_db"]
        assert stream["psnr_vs_cut_db"] > low["psnr_vs_cut_db"]
        ratio = low["times_the_paper_stream"]
        assert ratio == pytest.approx(low["mbps"] / stream["mbps"])
        assert stream["times_the_paper_stream"] is None
        assert {row["pictures"] for row in own.values()} == {"96 x 64 px"}
    assert data["judged_frames"] == [1, 2, 3, 5] and data["frames"] == 6
    assert "against all leaves" in data["title"]


@needs_av
def test_a_cut_of_all_leaves_is_said_to_equal_them(asked):
    data = figure.run(asked(tau_px=0.0, given={"trace": "stand"})).data
    assert "cut at times equal to all leaves" in data["title"]
    assert {row["cut_psnr_vs_leaves_db"] for row in data["rows"]} == {None}
    assert data["rows"][0]["leaves_rendered"] is True


@needs_av
def test_a_scene_too_large_to_render_whole_is_said_not_to_be_compared(asked, monkeypatch):
    monkeypatch.setattr(bandwidth, "MOST_LEAVES", 100)
    data = figure.run(asked(shrink=2, given={"trace": "walk"})).data
    assert "do not fit" in data["not_measured"] and "not measured" in data["title"]
    assert {row["psnr_vs_leaves_db"] for row in data["rows"]} == {None}
    assert {row["pictures"] for row in data["rows"]} == {"48 x 32 px"}
    assert {row["display"] for row in data["rows"]} == {"96 x 64 px, f 48.0 px"}


@needs_av
def test_a_view_of_nothing_is_refused(asked):
    with pytest.raises(InputError, match="bandwidth: no splat is visible from this view"):
        figure.run(asked(given={"trace": "stand", "view": "1e4,0,0:2e4,0,0"}))


@needs_av
def test_too_few_frames_for_a_search_are_refused(asked):
    with pytest.raises(InputError, match="--frames must be above the 4 of a search, not 4"):
        figure.run(asked(frames=4))
