"""The reference renderer against values worked out by hand, and against the textbook formulas."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians import reference
from gaussians.cameras import StereoRig
from gaussians.errors import InputError
from gaussians.scene import Scene
from tests import strategies
from tests.naive.projection import project_one
from tests.strategies import Splat, at_pixel, build_case, build_scene, small_rig

pytestmark = pytest.mark.nojit

C0 = 0.5 / math.sqrt(math.pi)
SIGMA2 = 0.3  # a point is only as wide as the dilation


def scene_of(splats: list[Splat], rig: StereoRig, colours: Sequence[tuple[float, ...]]) -> Scene:
    """Splats of one colour each, the same from everywhere."""
    sh = ((np.array(colours) - 0.5) / C0).reshape(len(colours), 1, 3)
    return build_scene(splats, rig, sh)


def point(rig: StereoRig, column: float, row: float, depth: float, opacity: float) -> Splat:
    """A Gaussian without extent of its own."""
    return Splat(at_pixel(rig, column, row, depth), (0.0, 0.0, 0.0), opacity)


def test_one_point_has_the_alpha_of_the_formula() -> None:
    rig = small_rig(9, 7)
    scene = scene_of([point(rig, 4.5, 3.5, 2.0, 0.5)], rig, [(1.0, 0.5, 0.25)])
    seen = reference.render_eye(scene, rig, "left")
    rows, columns = np.mgrid[0:7, 0:9]
    distance2 = (rows - 3) ** 2 + (columns - 4) ** 2
    alpha = 0.5 * np.exp(-0.5 * distance2 / SIGMA2)
    alpha[alpha < 1 / 255] = 0  # nearest ring below: 0.5*exp(-4/0.6) = 0.0006
    np.testing.assert_allclose(seen.transmittance, 1 - alpha, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        seen.image, alpha[..., None] * np.array([1.0, 0.5, 0.25]), rtol=0, atol=1e-6
    )
    assert (alpha > 0).sum() == 9


def test_the_right_eye_sees_it_further_left_by_b_f_over_z() -> None:
    rig = small_rig(24, 7)  # 0.0625 m * 32 px / 0.5 m = 4 px
    scene = scene_of([point(rig, 12.5, 3.5, 0.5, 0.5)], rig, [(1.0, 1.0, 1.0)])
    left = reference.render_eye(scene, rig, "left")
    right = reference.render_eye(scene, rig, "right")
    assert left.transmittance[3, 12] == right.transmittance[3, 8] == np.float32(0.5)
    np.testing.assert_array_equal(left.image[:, 4:], right.image[:, :-4])


def test_an_off_axis_window_shifts_the_right_image_by_its_offset() -> None:
    rig = small_rig(40, 7, offset_px=16)
    scene = scene_of([point(rig, 32.5, 3.5, 0.5, 0.5)], rig, [(1.0, 1.0, 1.0)])
    right = reference.render_eye(scene, rig, "right")
    assert right.transmittance.argmin() == 3 * 40 + 32 - 16 - 4


def test_nearer_splats_cover_farther_ones_and_ties_go_by_id() -> None:
    rig = small_rig(3, 3)
    red, green = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    near, far = point(rig, 1.5, 1.5, 1.0, 0.75), point(rig, 1.5, 1.5, 2.0, 0.75)
    for splats, order in (([far, near], [1, 0]), ([near, far], [0, 1]), ([near, near], [0, 1])):
        seen = reference.render_eye(scene_of(splats, rig, [red, green]), rig, "left")
        assert seen.ids.tolist() == order
        expected = np.array([0.0, 0.0, 0.0])
        expected[order[0]], expected[order[1]] = 0.75, 0.25 * 0.75
        np.testing.assert_allclose(seen.image[1, 1], expected, atol=1e-6)


def test_a_splat_never_hides_more_than_99_percent() -> None:
    rig = small_rig(3, 3)
    scene = scene_of([point(rig, 1.5, 1.5, 1.0, 44.0)], rig, [(1.0, 1.0, 1.0)])
    seen = reference.render_eye(scene, rig, "left")
    assert seen.transmittance[1, 1] == np.float32(1) - np.float32(0.99)
    # the opacity above 1 counts in the extent and at the neighbour: 44*exp(-1/0.6) is capped too
    assert seen.transmittance[1, 2] == np.float32(1) - np.float32(0.99)
    corner = 44 * math.exp(-1 / SIGMA2)
    assert corner > 0.99 and seen.transmittance[0, 0] == seen.transmittance[1, 1]


def test_a_pixel_stops_before_the_splat_that_would_fall_below_the_limit() -> None:
    rig = small_rig(1, 1)
    layers = [
        point(rig, 0.5, 0.5, z, o) for z, o in ((1.0, 0.99), (2.0, 0.985), (3.0, 0.9), (4, 0.1))
    ]
    scene = scene_of(layers, rig, [(0.0, 0.0, 0.0)] * 3 + [(1.0, 1.0, 1.0)])
    seen = reference.render_eye(scene, rig, "left", background=(1.0, 0.0, 0.0))
    # 0.01 * 0.015 = 1.5e-4 stays above 1e-4; the third would fall below: it and all behind are out
    np.testing.assert_allclose(seen.transmittance[0, 0], 1.5e-4, rtol=1e-4)
    assert seen.image[0, 0].tolist() == [seen.transmittance[0, 0], 0.0, 0.0]


def test_culls_name_the_first_reason_and_hold_for_both_eyes() -> None:
    rig = small_rig()
    near = np.float32(rig.near_m)
    faint = np.nextafter(np.float32(1 / 255), np.float32(0))
    splats = [
        point(rig, 9, 9, float(near), 0.5),
        point(rig, 9, 9, float(np.nextafter(near, np.float32(0))), 0.0),
        point(rig, 9, 9, -1.0, 0.5),
        point(rig, 9, 9, 1.0, float(faint)),
        point(rig, 9, 9, 1.0, float(np.float32(1 / 255))),
        Splat((0.0, 0.0, 1.0), (1e9, 0.0, 0.0), 0.5, (0.9, 0.1, 0.2, math.sqrt(0.14))),
    ]
    scene = scene_of(splats, rig, [(1.0, 1.0, 1.0)] * 6)
    for eye in ("left", "right"):
        drawn, culls = reference.project(scene, rig, eye)
        assert drawn.ids.tolist() == [0, 4]
        assert culls == reference.ReferenceCulls(behind_near=2, transparent=1, degenerate=1)


def test_a_determinant_lost_in_one_eye_only_culls_in_both() -> None:
    rig = small_rig(baseline_m=0.5)
    without_partner = small_rig(baseline_m=0.0)
    lost_in_one = 0
    for seed in range(20):
        scene = build_case([("needles", seed)], rig).scene
        left, culls = reference.project(scene, rig, "left")
        right, _ = reference.project(scene, rig, "right")
        assert left.ids.tolist() == right.ids.tolist()
        # a rig without baseline, standing where the left eye was: exact, 0.25 m is a float
        means = scene.means + np.array([0.25, 0.0, 0.0], np.float32)
        alone = Scene(means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
        lost_alone = reference.project(alone, without_partner, "left")[1].degenerate
        assert lost_alone <= culls.degenerate
        lost_in_one += culls.degenerate - lost_alone
    assert lost_in_one > 0


def test_empty_and_invisible_scenes_show_the_background() -> None:
    rig = small_rig(8, 6)
    empty = build_scene([], rig, np.zeros((0, 1, 3)))
    behind = build_case([("behind", 1)], rig).scene
    for scene in (empty, behind):
        seen = reference.render_eye(scene, rig, "right", background=(0.25, 0.5, 0.75))
        assert len(seen.ids) == 0
        assert (seen.transmittance == 1).all()
        assert (seen.image == np.array([0.25, 0.5, 0.75], np.float32)).all()


def test_bad_arguments_are_refused() -> None:
    rig = small_rig(4, 4)
    scene = build_case([("ordinary", 0)], rig).scene
    with pytest.raises(InputError, match='eye must be "left" or "right", not'):
        reference.render_eye(scene, rig, "middle")  # type: ignore[arg-type]  # the point of the test
    with pytest.raises(InputError, match="background must be three finite numbers"):
        reference.render_eye(scene, rig, "left", background=(0.0, float("nan"), 0.0))


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(strategies.cases())
def test_no_operation_leaves_float32(case: strategies.Case) -> None:
    for eye in ("left", "right"):
        splats, _ = reference.project(case.scene, case.rig, eye)
        for name, array in vars(splats).items():
            assert array.dtype == (np.int32 if name == "ids" else np.float32), name
        seen = reference.render_eye(case.scene, case.rig, eye, case.background)
        assert seen.image.dtype == seen.transmittance.dtype == np.float32
        assert np.isfinite(seen.image).all()
        assert (seen.transmittance >= np.float32(1e-4)).all() and (seen.transmittance <= 1).all()


@pytest.mark.parametrize("seed", range(4))
def test_projection_agrees_with_the_textbook(seed: int) -> None:
    rig = small_rig(
        focal=(37.3, 41.9), offset_px=16, pose=strategies.turned_pose(seed), baseline_m=0.3
    )
    groups = [(kind, seed) for kind in ("ordinary", "wall", "depth_ties", "left_of_the_left_image")]
    case = build_case(groups, rig, shuffle=seed)
    for eye in ("left", "right"):
        splats, _ = reference.project(case.scene, rig, eye)
        assert len(splats.ids) > 12
        for rank, number in enumerate(splats.ids):
            wanted = project_one(case.scene, int(number), rig, eye)
            a, b, c = (float(k[rank]) for k in (splats.a, splats.b, splats.c))
            covariance = np.linalg.inv(np.array([[a, b], [b, c]]))
            conditions = np.linalg.cond(wanted.covariance)
            scale = np.abs(wanted.covariance).max()
            # means sit ~20 m from the origin: float32 leaves about 4e-6 m, 20 px at the nearest
            assert np.abs(covariance - wanted.covariance).max() < 3e-5 * conditions * scale
            centre = np.array([splats.u[rank], splats.v[rank]])
            assert np.abs(centre - wanted.centre).max() < 4e-4 * (1 + 1 / wanted.depth)


def test_exp_is_close_to_exp() -> None:
    p = -np.linspace(0, 20, 200_001, dtype=np.float32)
    exact = np.exp(p.astype(np.float64))
    assert reference.exp(np.zeros(1, np.float32))[0] == 1
    assert np.abs(reference.exp(p) / exact - 1).max() < 2 * 2**-24


@given(st.floats(float(np.float32(1 / 255)), 1e6, width=32))
@settings(max_examples=200, deadline=None, derandomize=True, database=None)
def test_threshold_is_the_smallest_float_not_below_minus_ln(opacity: float) -> None:
    rig = small_rig(4, 4)
    scene = scene_of([point(rig, 2, 2, 1.0, opacity)], rig, [(1.0, 1.0, 1.0)])
    threshold = reference.project(scene, rig, "left")[0].thresholds[0]
    exact = -math.log(255 * opacity)
    assert float(threshold) >= exact > float(np.nextafter(threshold, np.float32(-np.inf)))


def harmonics_at(directions: np.ndarray) -> np.ndarray:
    """[directions, 16] basis values, read off the colours of one coefficient at a time."""
    count = len(directions)
    values = np.zeros((count, 16))
    for i in range(16):
        sh = np.zeros((count, 16, 3), np.float32)
        sh[:, i] = 0.25
        rgb = reference._colours(sh, directions.astype(np.float32), np.zeros(3, np.float32))
        values[:, i] = (rgb[:, 0].astype(np.float64) - 0.5) / 0.25
    return values


def test_spherical_harmonics_are_orthonormal_with_the_inria_signs() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(12)
    angles = np.arange(24) * (2 * np.pi / 24)
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, angles, indexing="ij"))
    r = np.sqrt(1 - z * z)
    directions = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    basis = harmonics_at(directions)
    area = np.repeat(weights, 24) * (2 * np.pi / 24)
    np.testing.assert_allclose(basis.T @ (basis * area[:, None]), np.eye(16), atol=2e-5)
    x, y, z = np.eye(3)
    assert harmonics_at(y[None])[0, 1] < 0 < harmonics_at(z[None])[0, 2]
    assert harmonics_at(x[None])[0, 3] < 0 < harmonics_at((x + y)[None])[0, 4]
    assert harmonics_at((y + z)[None])[0, 5] < 0 < harmonics_at(z[None])[0, 6]


def test_colour_is_never_negative_and_a_mean_in_the_eye_has_no_direction() -> None:
    sh = np.full((1, 16, 3), -2.0, np.float32)
    sh[0, 0] = (1.0, -9.0, 0.0)
    origin = np.zeros((1, 3), np.float32)
    rgb = reference._colours(sh, origin, origin[0])
    # all directional terms vanish at (0, 0, 0): what is left is C0*k0 + 0.5
    np.testing.assert_allclose(rgb[0], [C0 + 0.5, 0.0, 0.5], rtol=1e-6)
