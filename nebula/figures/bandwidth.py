"""Quality against Mbps: H.265 of the views against the Δcut stream (paper Sec. 7.1, Fig. 17).

Both sides show the same frames and are judged by the same pictures: both eyes of the uncoded cut,
searched anew at every frame's pose, in 8 bit; and, where the scene is small enough, of all leaves.
The video is coded at the size of these pictures. The stream does not depend on it: its LoD is that
of the display, whose focal length and τ count. Nothing is scaled from one size to another.

The stream is searched every w frames and arrives at once and whole, so its error is that of the
codec and of poses up to w - 1 frames old. Rates are without the first frame or message: the I
frame and the first cut stand beside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import Display
from gaussians.errors import InputError
from gaussians.poses import HeadTrace
from gaussians.quality import psnr_db, to_8bit
from gaussians.render import render_stereo
from gaussians.scene import Scene
from gaussians.stereo_method import PRESETS
from lod_cloud import Client, Cloud, TreeEncoder, make_search
from lod_cloud.cloud import HYSTERESIS
from nebula.figures.bandwidth_chart import draw, table
from nebula.figures.codecs import train_codecs
from nebula.figures.output import Figure
from nebula.figures.trees import (
    SEARCH_EVERY,
    Subject,
    choose_motions,
    choose_tree,
    motion_name,
    speed_m_s,
)
from nebula.figures.video import PRESET, QUALITIES, UInt8, require_av, transcode
from nebula.options import FigureOptions
from nebula.progress import progress
from nebula.scene_input import require_visible
from nebula.session_config import load_session_config

FRAMES = 17
SHRINK = 4
JUDGED = 4  # frames at which pictures are compared, both eyes
MOST_LEAVES = 2_000_000  # that are rendered as a whole
PAPER_RATIO = 19.25
DIFFERENCE = (
    "The paper's factor is against its lossy high quality, whose rate factor it does not give, at "
    "2064 x 2208 pixels, for scenes and motions that are not available here. Video grows with the "
    "number of pixels, the stream does not; the stream grows with the speed of the head and the "
    "density of the scene, video hardly does. So the factor is a property of motion, scene and "
    "resolution together."
)


def make(options: FigureOptions) -> Figure:
    """One row per motion and way of coding."""
    require_av()
    frames = options.frames or FRAMES
    every = options.search_every or SEARCH_EVERY
    if frames <= every:
        raise InputError(f"--frames must be above the {every} of a search, not {frames}")
    subject = choose_tree(options)
    display = shrunk(subject.display, options.shrink or SHRINK)
    motions, _ = choose_motions(options, recorded=False)
    codecs = train_codecs(subject.tree, subject.seed)
    encoders = {name: TreeEncoder(subject.tree, codec) for name, codec in codecs.items()}
    rows: list[dict[str, Any]] = []
    for motion in motions:
        trace = subject.trace(motion, frames)
        views = Views(subject, trace, display, options.baseline_m)
        context = {
            **subject.labels,
            "pictures": f"{display.width} x {display.height} px",
            "trace": motion_name(motion),
            "speed_m_s": speed_m_s(trace),
            "leaves_rendered": bool(views.leaves),
            "cut_psnr_vs_leaves_db": views.lod_psnr_db(),
        }
        coded = [*video_rows(views), *stream_rows(views, encoders, every)]
        rows += [{**context, **row} for row in coded]
    _compare(rows)
    notes = {
        "scenes": [subject.description],
        "frames": frames,
        "search_every": every,
        "judged_frames": views.judged,
        "definitions": __doc__,
        "video": {"coder": "libx265", "preset": PRESET, "tune": "zerolatency", "P frames": "all"},
        "paper": {
            "video_over_stream": PAPER_RATIO,
            "reference": "Sec. 7.1, Sec. 7.2, Fig. 17, Fig. 19",
            "difference": DIFFERENCE,
        },
    }
    if subject.tree.leaves > MOST_LEAVES:
        notes["not_measured"] = f"against all leaves: {subject.tree.leaves} do not fit the renderer"
    return Figure(
        f"Bandwidth: {subject.title}, {lod_in_words(rows)}",
        notes,
        rows,
        lambda canvas: draw(canvas, rows),
        table(rows) + f"\npaper: lossy high video needs {PAPER_RATIO} times the stream's rate",
    )


def shrunk(display: Display, factor: int) -> Display:
    """The same field of view in 1 / factor of the pixels each way, rounded down to even numbers.

    Raises InputError where fewer than 16 pixels are left.
    """
    width, height = (2 * (size // (2 * factor)) for size in (display.width, display.height))
    if min(width, height) < 16:
        raise InputError(f"--shrink {factor}: pictures must keep 16 pixels, not {width} x {height}")
    return replace(
        display,
        width=width,
        height=height,
        fx=display.fx * width / display.width,
        fy=display.fy * height / display.height,
        cx_left=display.cx_left * width / display.width,
        cx_right=display.cx_right * width / display.width,
        cy=display.cy * height / display.height,
    )


@dataclass
class MeanError:
    """Mean squared error of 8-bit pictures over all that were added."""

    errors: list[float] = field(default_factory=list)

    def add(self, shown: UInt8, reference: UInt8) -> None:
        psnr = psnr_db(_unit(shown), _unit(reference))
        self.errors.append(0.0 if psnr is None else 10.0 ** (-psnr / 10.0))

    @property
    def psnr_db(self) -> float | None:
        """None where all pictures are equal, and where there are none."""
        error = float(np.mean(self.errors)) if self.errors else 0.0
        return -10.0 * float(np.log10(error)) if error > 0 else None


def _unit(image: UInt8) -> NDArray[np.float32]:
    """8-bit numbers as 0 to 1."""
    return image.astype(np.float32) / np.float32(255)


class Views:
    """The frames of one motion as everyone should show them; both eyes, 8 bit."""

    def __init__(
        self, subject: Subject, trace: HeadTrace, display: Display, baseline_m: float
    ) -> None:
        self.subject, self.trace = subject, trace
        self._display, self._baseline_m = display, baseline_m
        frames = len(trace)
        self.judged = np.unique(np.linspace(1, frames - 1, JUDGED).astype(int)).tolist()
        search = make_search("wheel", subject.hot)
        gaussians = subject.tree.gaussians
        self.pictures: list[tuple[UInt8, UInt8]] = []  # of the uncoded cut, frame by frame
        with progress(f"{trace.name}: frames", frames) as step:
            for frame in range(frames):
                cut = search.search(subject.request(trace, frame)).cut
                self.pictures.append(self.render(gaussians.take(cut), frame))
                step()
        self.leaves = self._all_leaves()

    def render(self, scene: Scene, frame: int) -> tuple[UInt8, UInt8]:
        """Both eyes of a scene in a frame."""
        rig = self.subject.rig(self.trace, frame, self._display, self._baseline_m)
        drawn = render_stereo(scene, rig, PRESETS["exact"])
        if frame == 0:  # later ones may look away
            require_visible(sum(drawn.visible), "bandwidth")
        return to_8bit(drawn.left), to_8bit(drawn.right)

    def _all_leaves(self) -> dict[int, tuple[UInt8, UInt8]]:
        """Judged frames of all leaves; none where there are too many."""
        tree = self.subject.tree
        if tree.leaves > MOST_LEAVES:
            return {}
        scene = tree.gaussians.take(tree.leaf_nodes())
        return {frame: self.render(scene, frame) for frame in self.judged}

    def lod_psnr_db(self) -> float | None:
        """Of the uncoded cut against all leaves."""
        return self.compared({frame: self.pictures[frame] for frame in self.judged})[
            "psnr_vs_leaves_db"
        ]

    def compared(self, shown: dict[int, tuple[UInt8, UInt8]]) -> dict[str, float | None]:
        """PSNR of judged frames as someone shows them; None: identical, or no leaves."""
        cut, leaves = MeanError(), MeanError()
        for frame, eyes in shown.items():
            for eye in range(2):
                cut.add(eyes[eye], self.pictures[frame][eye])
                if frame in self.leaves:
                    leaves.add(eyes[eye], self.leaves[frame][eye])
        return {"psnr_vs_cut_db": cut.psnr_db, "psnr_vs_leaves_db": leaves.psnr_db}


def video_rows(views: Views) -> list[dict[str, Any]]:
    """Both eyes coded one by one in every quality."""
    rate_hz = load_session_config().display_rate.hz
    rows = []
    with progress(f"{views.trace.name}: video", len(QUALITIES)) as step:
        for quality in QUALITIES:
            eyes = [
                transcode([pictures[eye] for pictures in views.pictures], quality, rate_hz)
                for eye in range(2)
            ]
            shown = {f: (eyes[0].frames[f], eyes[1].frames[f]) for f in views.judged}
            rows.append(
                {
                    "side": "video",
                    "coding": quality.name,
                    "mbps": sum(eye.steady_mbps(rate_hz) for eye in eyes),
                    "first_bytes": sum(eye.first_bytes for eye in eyes),
                    **views.compared(shown),
                }
            )
            step()
    return rows


def stream_rows(views: Views, encoders: dict[str, TreeEncoder], every: int) -> list[dict[str, Any]]:
    """The Δcut stream by every codec, and by the last one with hysteresis."""
    rows = []
    for name, encoder in encoders.items():
        rows.append(_stream_row(views, name, encoder, every, 0.0))
    rows.append(_stream_row(views, f"{name}, hysteresis", encoder, every, HYSTERESIS))
    return rows


def _stream_row(
    views: Views, name: str, encoder: TreeEncoder, every: int, hysteresis: float
) -> dict[str, Any]:
    config = load_session_config()
    subject, frames = views.subject, len(views.trace)
    cloud = Cloud(
        subject.tree,
        encoder,
        search=make_search("wheel", subject.hot, hysteresis=hysteresis),
        frames_per_search=every,
        reuse_window_frames=config.reuse_window.frames,
    )
    client = Client()
    client.receive(cloud.session_start())
    sizes: list[int] = []
    shown: dict[int, tuple[UInt8, UInt8]] = {}
    with progress(f"{views.trace.name}: stream, {name}", frames) as step:
        for frame in range(frames):
            request = subject.request(views.trace, frame)
            if frame % every == 0:
                message = cloud.search(request, frame)
                client.receive(message)
                cloud.receive(client.report())
                sizes.append(len(message))
            if frame in views.judged:
                shown[frame] = views.render(client.select(request).scene, frame)
            step()
    served = (len(sizes) - 1) * every
    return {
        "side": "stream",
        "coding": f"Δcut, {name}",
        "hysteresis": hysteresis,
        "mbps": 8e-6 * sum(sizes[1:]) * config.display_rate.hz / served,
        "first_bytes": sizes[0],
        **views.compared(shown),
    }


def _compare(rows: Sequence[dict[str, Any]]) -> None:
    """How many times the rate of each stream a video of the same motion takes."""
    for row in rows:
        streams = [r for r in rows if r["side"] == "stream" and r["trace"] == row["trace"]]
        for stream in streams:
            codec = stream["coding"].removeprefix("Δcut, ").replace(", ", "_")
            ratio = row["mbps"] / stream["mbps"] if stream["mbps"] else None
            row[f"times_the_{codec}_stream"] = ratio if row["side"] == "video" else None


def lod_in_words(rows: Sequence[dict[str, Any]]) -> str:
    """The cut's own error, as it stands in the title."""
    if not rows[0]["leaves_rendered"]:
        return "its error against all leaves not measured"
    found = [row["cut_psnr_vs_leaves_db"] for row in rows]
    if None in found:
        return "cut at times equal to all leaves"
    shown = dict.fromkeys(f"{value:.1f}" for value in (min(found), max(found)))
    return f"cut {' to '.join(shown)} dB against all leaves"
