"""The work trace of the renderer itself, timed: what both levels must agree on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from arch import AcceleratorConfig, analyse_frame
from gaussians.cameras import Display, StereoRig, look_at
from gaussians.render import render_stereo
from gaussians.scene import Scene, normalised_quaternions
from gaussians.stereo_method import PRESETS
from gaussians.tiling import Intersection
from gaussians.work import FrameWork
from tests.arch.build import client


def rendered(method: str, intersection: Intersection) -> FrameWork:
    """A cloud of 300 splats, 50 x 38 px, disparities up to five tiles."""
    rng = np.random.default_rng(4)
    count = 300
    means = rng.uniform((-1, -0.8, 0.6), (1, 0.8, 3), (count, 3)).astype(np.float32)
    scene = Scene(
        means,
        normalised_quaternions(rng.normal(size=(count, 4))),
        rng.uniform(0.01, 0.1, (count, 3)).astype(np.float32),
        rng.uniform(0.2, 1.0, count).astype(np.float32),
        rng.normal(0, 0.3, (count, 4, 3)).astype(np.float32),
    )
    pose = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
    rig = StereoRig(Display.from_fov(50, 38, 70.0), pose)
    preset = dataclasses.replace(PRESETS[method], intersection=intersection)
    return render_stereo(scene, rig, preset).work


@pytest.mark.parametrize("method", ["exact", "independent", "paper"])
def test_counts_of_the_trace_arrive(nebula: AcceleratorConfig, method: str) -> None:
    work = rendered(method, PRESETS[method].intersection)
    analysis = analyse_frame(nebula, work, client(300))
    activity = analysis.activity
    assert analysis.timing.cycles_per_frame > 0
    assert activity["alpha_checks"] == work.left.alpha_checks.sum() + work.right.alpha_checks.sum()
    assert activity["blends"] > 0
    assert activity["splats_transformed"] == (600 if method == "independent" else 300)
    if method == "independent":
        assert activity["stereo_buffer_writes"] == 0
        assert activity["pairs_emitted"] == work.front_end.left_pairs + work.front_end.right_pairs
    if method == "exact":
        assert activity["stereo_buffer_writes"] == work.front_end.right_pairs
        examined = work.left.entries.sum() + work.stereo.forward_only.sum()
        assert activity["sru_entries_examined"] == examined


def test_gscore_times_its_own_lists(gscore: AcceleratorConfig) -> None:
    work = rendered(gscore.workload.stereo_method, gscore.workload.intersection)
    timing = analyse_frame(gscore, work, client(300)).timing
    assert timing.stereo_buffer is None
    assert "merge_unit" not in {unit.name for unit in timing.units}
