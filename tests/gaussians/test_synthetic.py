"""The generated city: exact counts, same bits, the promised distributions, a closed street."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.cameras import Display, StereoRig, look_at
from gaussians.constants import SH_C0
from gaussians.errors import InputError
from gaussians.render import render_mono
from gaussians.scene import FIELDS, Scene
from gaussians.synthetic import City, generate_city
from gaussians.synthetic.layout import CARRIAGEWAY_HALF_M, HALF_EXTENT_M, town
from gaussians.synthetic.noise import systematic_counts, unit_circle, value_noise
from gaussians.synthetic.patches import Patches
from gaussians.synthetic.splats import Shape, surface_splats, translucent

UP = np.array([0.0, 0.0, 1.0])
GOLDEN = "f545a3916fd80141"


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def digest(scene: Scene) -> str:
    sha = hashlib.sha256()
    for field in FIELDS:
        sha.update(np.ascontiguousarray(getattr(scene, field)).tobytes())
    return sha.hexdigest()


@pytest.fixture(scope="module")
def city() -> City:
    return generate_city(300_000, seed=1)


def test_same_seed_same_bits_on_every_machine() -> None:
    small = generate_city(3_000, seed=7)
    assert digest(small.scene) == digest(generate_city(3_000, seed=7).scene)
    assert digest(small.scene) != digest(generate_city(3_000, seed=8).scene)
    assert digest(small.scene)[:16] == GOLDEN


@settings(max_examples=8, deadline=None)
@given(leaves=st.integers(1_000, 9_000), seed=st.integers(0, 2**63 - 1), degree=st.integers(0, 3))
def test_counts_are_exact_and_scenes_valid(leaves: int, seed: int, degree: int) -> None:
    scene = generate_city(leaves, seed, sh_degree=degree).scene
    assert len(scene.validate()) == leaves
    assert scene.sh_degree == degree
    assert (scene.scales > 0).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((999, 1), "leaves must lie in 1000..20000000, not 999"),
        ((20_000_001, 1), "leaves must lie in 1000..20000000, not 20000001"),
        ((1_000, -1), "seed must be an integer >= 0, not -1"),
        ((1_000, 1, 4), "sh_degree must be 0, 1, 2 or 3, not 4"),
    ],
)
def test_bad_arguments_are_refused(arguments: tuple[int, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        generate_city(*arguments)


def test_opacities_are_two_fifths_near_one_the_rest_faint(city: City) -> None:
    opacities = city.scene.opacities
    assert 0.39 < (opacities >= 0.9).mean() < 0.41
    assert opacities.min() >= 1 / 255
    assert opacities.max() < 1
    faint = opacities[opacities < 0.9]
    assert 0.10 < np.median(faint) < 0.19  # Beta(0.8, 2.8): 0.169, less the floaters
    assert 0.05 < (opacities < 0.067).mean() / 0.54 - 0.258 < 0.15  # floaters on top of Beta


def test_translucent_samples_follow_the_beta_distribution() -> None:
    samples = translucent(generator(3), 200_000)
    assert samples.mean() == pytest.approx(0.8 / 3.6, abs=0.005)
    assert samples.std() == pytest.approx((2.24 / (12.96 * 4.6)) ** 0.5, rel=0.03)


def test_splats_are_flat_and_lie_in_their_surface(city: City) -> None:
    scene = city.scene
    ordered = np.sort(scene.scales, axis=1)
    flatness = ordered[:, 0] / ordered[:, 1]
    assert np.median(flatness) < 0.2
    assert np.median(ordered[:, 2] / ordered[:, 1]) > 1.2
    x, y, z = scene.means.T
    road = (np.abs(y) < 1.9) & (np.abs(z) < 0.01) & (np.abs(x) < 40)
    assert road.sum() > 5_000
    assert np.median(np.abs(local_axis(scene.quaternions, 2)[road, 2])) > 0.999
    front = (np.abs(np.abs(y) - 7.5) < 0.02) & (z > 6) & (z < 9) & (np.abs(x + 40) < 30)
    assert front.sum() > 5_000
    assert np.median(np.abs(local_axis(scene.quaternions, 2)[front, 2])) < 0.01


def test_local_axes_are_those_of_the_rectangle() -> None:
    rng = generator(5)
    raw = rng.normal(size=(400, 3, 3))
    u = raw[:, 0] / np.linalg.norm(raw[:, 0], axis=1, keepdims=True)
    v = raw[:, 1] - (raw[:, 1] * u).sum(axis=1, keepdims=True) * u
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    count = len(u)
    ones = np.ones(count)
    patches = Patches(
        raw[:, 2],
        u,
        v,
        np.full((count, 2), 9.0),
        np.zeros(count, np.int64),
        np.full((count, 3), 0.5),
        np.arange(count, dtype=np.uint32),
        ones,
    )
    for turn in (0.0, 0.4):
        shape = Shape(reach=0.5, aspect=2.0, turn=turn, jitter=0.0)
        place = (4.0 * ones, 5.0 * ones)
        chunk = surface_splats(rng, patches, np.arange(count), place, 0.1 * ones, ones, shape)
        x_axis, y_axis, z_axis = (local_axis(chunk.quaternions, k) for k in range(3))
        assert np.allclose(z_axis, patches.normals)
        cosine, sine = (x_axis * u).sum(axis=1), (x_axis * v).sum(axis=1)
        assert np.allclose((y_axis * v).sum(axis=1), cosine)
        assert np.allclose(cosine**2 + sine**2, 1)
        assert np.degrees(np.abs(np.arctan2(sine, cosine)).max()) == pytest.approx(
            2 * np.degrees(np.arctan(turn)), abs=1.5
        )
        assert np.allclose(chunk.means, raw[:, 2] + 4 * u + 5 * v)


def local_axis(quaternions: np.ndarray, index: int) -> np.ndarray:
    """[N, 3] column of the rotation matrices (gaussians/conventions.md)."""
    w, x, y, z = quaternions.T
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack(columns[index], axis=1)


def test_floaters_are_faint_and_keep_off_the_walk(city: City) -> None:
    scene = city.scene
    ratios = scene.scales[:, 1:] / scene.scales[:, :1]
    floaters = (np.abs(ratios - (0.7, 0.5)) < 1e-5).all(axis=1) & (scene.opacities < 0.07)
    assert floaters.mean() == pytest.approx(0.06, abs=0.001)
    _, y, z = scene.means[floaters].T
    assert np.sqrt(y * y + (z - 1.6) ** 2).min() > 1.4


def test_splats_are_smaller_near_the_walk(city: City) -> None:
    x, y, z = city.scene.means.T
    size = city.scene.scales.max(axis=1)
    facade = (np.abs(np.abs(y) - 7.5) < 0.01) & (z > 1) & (z < 8)
    near, far = facade & (np.abs(x + 40) < 5), facade & (x > 65)
    assert 2 * np.median(size[near]) < np.median(size[far])


def test_harmonics_fall_with_the_degree(city: City) -> None:
    sh = city.scene.sh
    for degree, (low, high) in {1: (1, 4), 2: (4, 9), 3: (9, 16)}.items():
        assert sh[:, low:high].std() == pytest.approx(0.06 / degree, rel=0.15)
        assert abs(sh[:, low:high].mean()) < 0.01
    head_on = sh[:, 0] * SH_C0 + 0.5
    assert head_on.min() > -1e-6
    assert head_on.max() < 1 + 1e-6
    assert head_on.std() > 0.15  # textured, not grey


def test_the_town_lies_where_it_should(city: City) -> None:
    means = city.scene.means
    inside = (np.abs(means[:, :2]) < HALF_EXTENT_M).all(axis=1)
    assert inside.mean() > 0.9
    assert np.abs(means).max() < 175
    assert means[inside, 2].min() > -0.6
    geometry = town(generator(1))
    axes = geometry.patches.axis_u, geometry.patches.axis_v, geometry.patches.normals
    for index, axis in enumerate(axes):
        assert np.allclose((axis * axis).sum(axis=1), 1)
        assert np.allclose((axis * axes[index - 1]).sum(axis=1), 0, atol=1e-12)


def test_the_walk_stays_on_the_carriageway_and_meets_nothing(city: City) -> None:
    path = city.path
    assert np.abs(path[:, 1]).max() < 0.25 * CARRIAGEWAY_HALF_M
    assert (path[:, 2] == 1.6).all()
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert 0.99 < steps.min() <= steps.max() < 1.1
    assert np.array_equal(city.eye, path[0])
    assert city.start.rotation[0, 2] > 0.95  # the first view looks down the street
    solid = city.scene.means[city.scene.opacities > 0.9]
    for eye in path:
        assert np.abs(solid - eye).max(axis=1).min() > 0.7


@pytest.mark.parametrize("walked_m", [0.0, 5.0])
def test_no_gap_shows_the_void(city: City, walked_m: float) -> None:
    step = np.array([walked_m, 0.0, 0.0])
    pose = look_at(city.eye + step, city.target + step, UP)
    image, transmittance = render_mono(
        city.scene, StereoRig(Display.from_fov(1024, 1024, 90.0), pose)
    )
    assert (transmittance > 0.1).mean() < 1e-4
    sky, road = image[100:200, 450:550], image[900:, 450:550]
    assert sky[..., 2].mean() > 1.2 * sky[..., 0].mean()
    assert road.mean() < 0.5 * sky[..., 2].mean()
    assert np.ptp(road.mean(axis=2)) > 0.05


@given(
    weights=st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=40),
    total=st.integers(0, 2_000),
    start=st.floats(0, 1, exclude_max=True),
)
def test_systematic_counts_sum_up_and_keep_to_their_shares(
    weights: list[float], total: int, start: float
) -> None:
    shares = np.array(weights)
    counts = systematic_counts(shares, total, start)
    assert counts.sum() == total
    assert (counts >= 0).all()
    assert np.abs(counts - shares / shares.sum() * total).max() < 1 + 1e-9


def test_unit_circle_has_unit_length_and_nearly_the_angle() -> None:
    turns = np.linspace(0, 0.9999, 1_000)
    x, y = unit_circle(turns)
    assert np.allclose(x * x + y * y, 1)
    angle = np.unwrap(np.arctan2(y, x))
    assert np.degrees(np.abs(angle - turns * 2 * np.pi)).max() < 1


def test_value_noise_is_continuous_and_covers_its_range() -> None:
    x = np.linspace(-20, 20, 40_001)
    noise = value_noise(np.full(len(x), 5, np.uint32), x, 0.37 * x)
    assert np.abs(np.diff(noise)).max() < 0.004
    assert noise.min() >= 0
    assert noise.max() < 1
    assert noise.std() > 0.15
