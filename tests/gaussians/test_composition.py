"""Instanced compositions: equal to transforming by hand, and culled without changing a pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.cameras import Display, StereoRig, look_at
from gaussians.composition import Composition, Instances
from gaussians.errors import InputError
from gaussians.projection import project
from gaussians.render import render_stereo
from gaussians.rotations import rotations_from_quaternions
from gaussians.scene import FIELDS, Scene, concatenate
from gaussians.stereo_method import PRESETS
from gaussians.transforms import transformed
from tests.gaussians.real_data import data_file
from tests.strategies import KINDS, build_case, rigs, small_rig

TOO_LONG = ("needles", "far_needles", "outliers", "huge_at_the_near_plane", "wall", "zero_scales")
WELL_CONDITIONED = [kind for kind in KINDS if kind not in TOO_LONG]


def base_scene(seed: int, degree: int = 0) -> Scene:
    """Five ordinary Gaussians within a few units of the origin."""
    case = build_case([("ordinary", seed)], small_rig(), degree=degree)
    return transformed(case.scene, np.eye(3), 0.25)


def random_instances(count: int, seed: int, bases: int = 1, spread: float = 4.0) -> Instances:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    return Instances(
        rng.integers(0, bases, count),
        np.exp(rng.uniform(-2, 1, count)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        rng.normal(0, spread, (count, 3)),
    )


def test_every_instance_is_its_base_transformed():
    bases = [base_scene(1), base_scene(2, degree=2), base_scene(3, degree=1)]
    instances = random_instances(9, 5, bases=3)
    composition = Composition(bases, instances)
    order = np.array([4, 0, 8, 0])
    rotations = rotations_from_quaternions(instances.quaternions)
    parts = [
        transformed(
            bases[instances.bases[i]],
            rotations[i],
            float(instances.scales[i]),
            tuple(instances.positions[i]),
        )
        for i in order
    ]
    wide = [*parts, bases[1].take(np.arange(0))]  # all of the highest degree
    expected, found = concatenate(wide), composition.compose(order).validate()
    for field in FIELDS:
        assert np.array_equal(getattr(found, field), getattr(expected, field))
    assert composition.count(order) == len(found) == 20
    assert composition.scene_bytes(order) == sum(getattr(found, field).nbytes for field in FIELDS)


def test_harmonics_turn_with_their_instance():
    base, instances = base_scene(1, degree=3), random_instances(1, 3)
    rig = StereoRig(
        Display.from_fov(40, 40, 60), look_at(*np.array([[3, 0, 0], [0, 0, 0], [0, 0, 1]]))
    )
    turn = rotations_from_quaternions(instances.quaternions)[0]
    still = Instances(
        np.zeros(1, np.int64), np.ones(1), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3))
    )
    turned = Instances(still.bases, still.scales, instances.quaternions, still.positions)
    pose = look_at(turn @ rig.pose.position, np.zeros(3), turn @ np.array([0.0, 0.0, 1.0]))
    there = StereoRig(rig.display, pose)
    before = render_stereo(Composition([base], still).compose(), rig, PRESETS["independent"])
    after = render_stereo(Composition([base], turned).compose(), there, PRESETS["independent"])
    assert before.visible[0] > 0
    np.testing.assert_allclose(after.left, before.left, atol=2e-4)


def test_parts_join_to_the_whole():
    composition = Composition([base_scene(1), base_scene(2)], random_instances(7, 1, bases=2))
    chosen = np.array([6, 2, 3, 5, 1])
    parts = list(composition.iterate(2, chosen))
    assert [indices.tolist() for indices, _ in parts] == [[6, 2], [3, 5], [1]]
    whole = composition.compose(chosen)
    assert np.array_equal(concatenate([part for _, part in parts]).means, whole.means)
    assert len(composition.compose(chosen[:0])) == 0
    with pytest.raises(InputError, match="instances at once must be >= 1, not 0"):
        next(composition.iterate(0))


@given(
    st.lists(
        st.tuples(st.sampled_from(WELL_CONDITIONED), st.integers(0, 999)), min_size=1, max_size=3
    ),
    rigs(),
    st.integers(0, 999),
    st.sampled_from([0.02, 0.3, 1.0]),
)
@settings(max_examples=150)
def test_culling_changes_no_pixel(groups, rig, seed, size):
    """Near the rig, so that instances stand around it, across window edges and the near plane."""
    case = build_case(groups, small_rig())
    count = 12
    free = random_instances(count, seed, spread=3.0)
    placed = Instances(
        free.bases, size * free.scales, free.quaternions, free.positions + rig.pose.position
    )
    composition = Composition([case.scene], placed)
    cull = composition.visible(rig)
    assert len(cull.indices) + cull.left_out == count
    assert (np.diff(cull.indices) > 0).all()
    kept = render_stereo(composition.compose(cull.indices), rig, PRESETS["independent"])
    whole = render_stereo(composition.compose(), rig, PRESETS["independent"])
    assert whole.work.front_end.ill_conditioned == kept.work.front_end.ill_conditioned
    for eye in ("left", "right", "left_transmittance", "right_transmittance"):
        assert np.array_equal(getattr(kept, eye), getattr(whole, eye))
    assert kept.visible == whole.visible


def test_an_instance_whose_middle_is_behind_the_viewer_may_reach_into_view():
    one = base_scene(1).take(np.zeros(2, np.int64))
    ends = np.array([[0, 0, -10], [0, 0, 3]], np.float32)
    base = Scene(ends, one.quaternions, one.scales, one.opacities, one.sh)
    upright, middle = np.array([[1.0, 0.0, 0.0, 0.0]]), np.zeros((1, 3))
    composition = Composition([base], Instances(np.zeros(1, np.int64), np.ones(1), upright, middle))
    assert composition.depths(small_rig())[0] < -3
    assert composition.visible(small_rig()).indices.tolist() == [0]
    assert render_stereo(composition.compose(), small_rig(), PRESETS["exact"]).visible == (1, 1)


def test_culling_names_why_and_is_not_wasteful():
    """A ring of small instances around a 60 degree camera: about a sixth of them is kept."""
    base = transformed(base_scene(1), np.eye(3), 0.01)
    angles = np.arange(360) * (np.pi / 180)
    ring = np.stack([5 * np.sin(angles), np.zeros(360), 5 * np.cos(angles)], axis=1)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (360, 1))
    composition = Composition(
        [base], Instances(np.zeros(360, np.int64), np.ones(360), upright, ring)
    )
    rig = StereoRig(
        Display.from_fov(400, 300, 60.0), look_at(np.zeros(3), ring[0], np.array([0, -1.0, 0]))
    )
    cull = composition.visible(rig)
    assert 61 <= len(cull.indices) <= 69
    assert set(range(31)) | set(range(330, 360)) <= set(cull.indices.tolist())
    assert 180 <= cull.behind_near <= 187  # z < 0.2: 92.3 degrees and more from straight ahead
    assert len(cull.indices) + cull.behind_near + cull.outside == 360
    assert composition.depths(rig).argmax() in (0, 1, 359)
    right_only = StereoRig(rig.display, rig.pose, baseline_m=9.0)
    wide = composition.visible(right_only).indices
    assert len(project(composition.compose(wide), right_only).ids) <= 5 * len(wide)
    assert not np.array_equal(wide, cull.indices)


def bad(**changes: object) -> Instances:
    good = random_instances(3, 0)
    fields = {f: getattr(good, f).copy() for f in ("bases", "scales", "quaternions", "positions")}
    for field, value in changes.items():
        if isinstance(value, np.ndarray):
            fields[field] = value
        else:
            fields[field][1] = value
    return Instances(**fields)


@pytest.mark.parametrize(
    ("instances", "message"),
    [
        (bad(scales=0.0), "instance 1: scale must be a positive number, not 0.0"),
        (bad(scales=np.nan), "instance 1: scale must be a positive number, not nan"),
        (bad(scales=np.inf), "instance 1: scale must be a positive number, not inf"),
        (bad(quaternions=0.0), "instance 1: quaternion must have length 1, not 0.0"),
        (bad(quaternions=np.nan), "instance 1: quaternion must have length 1, not nan"),
        (bad(positions=np.inf), "instance 1: position must be finite"),
        (bad(positions=1e13), "instance 1 must stay within 1e\\+12 units, not 1e\\+13"),
        (bad(scales=1e300), "instance 1 must stay within 1e\\+12 units"),
        (bad(bases=1), "instance 1: base must lie in 0..0, not 1"),
        (bad(bases=-1), "instance 1: base must lie in 0..0, not -1"),
        (bad(positions=np.zeros((2, 3))), "positions must have shape .3, 3., not .2, 3."),
    ],
)
def test_wrong_instances_are_refused(instances, message):
    with pytest.raises(InputError, match=f"sea: {message}"):
        Composition([base_scene(1)], instances, "sea")


def test_wrong_bases_and_indices_are_refused(monkeypatch):
    base, instances = base_scene(1), random_instances(3, 0)
    with pytest.raises(InputError, match="at least one base scene and one instance"):
        Composition([], instances)
    with pytest.raises(InputError, match="at least one base scene and one instance"):
        Composition([base], random_instances(0, 0))
    with pytest.raises(InputError, match="base scene 0 must hold at least one Gaussian"):
        Composition([base.take(np.arange(0))], instances)
    broken = base.take(np.arange(5))
    broken.scales[2, 1] = -1
    with pytest.raises(InputError, match="base scene 0: scales must be >= 0; Gaussian 2"):
        Composition([broken], instances)
    composition = Composition([base], instances)
    for indices in ([3], [-1], [[0]]):
        with pytest.raises(InputError, match="must be a list of numbers from 0 to 2"):
            composition.compose(np.array(indices))
    monkeypatch.setattr("gaussians.composition._COUNT_LIMIT", 14)
    with pytest.raises(InputError, match="at most 14 Gaussians can be composed, not 15"):
        composition.compose()


@pytest.mark.real_data
def test_what_the_sea_of_donuts_leaves_out_was_not_to_be_seen():
    from gaussians.formats.layout import read_composition

    composition, layout, _ = read_composition(data_file("scenes/donut/DonutSea.json"))
    published = layout.cameras[220]  # between two donuts: few are in view
    display = Display.from_fov(96, 54, 45.0)
    rig = StereoRig(display, published.pose, baseline_m=0.006, near_m=0.01)
    cull = composition.visible(rig)
    assert 40 < len(cull.indices) < 100
    near = np.flatnonzero(composition.depths(rig) < 0.4)
    more = np.union1d(cull.indices, near[:60])
    assert len(more) > len(cull.indices) + 20
    method = PRESETS["exact"]
    kept = render_stereo(composition.compose(cull.indices), rig, method)
    whole = render_stereo(composition.compose(more), rig, method)
    assert np.array_equal(kept.left, whole.left)
    assert np.array_equal(kept.right, whole.right)
    assert (kept.left_transmittance < 0.5).all()
