import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.scene import Scene, concatenate, normalised_quaternions


def scene(count: int = 3, coefficients: int = 4) -> Scene:
    return Scene(
        means=np.arange(3 * count, dtype=np.float32).reshape(count, 3),
        quaternions=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), 0.1, np.float32),
        opacities=np.full(count, 0.5, np.float32),
        sh=np.zeros((count, coefficients, 3), np.float32),
    )


@pytest.mark.parametrize("coefficients, degree", [(1, 0), (4, 1), (9, 2), (16, 3)])
def test_sh_degree_follows_from_the_coefficients(coefficients, degree):
    assert scene(coefficients=coefficients).validate().sh_degree == degree


@pytest.mark.parametrize(
    "field, value, message",
    [
        ("means", np.nan, "test: means must be finite; 1 of 3 Gaussians are not, the first is"),
        ("scales", -1.0, r"test: scales must be >= 0; Gaussian 1"),
        ("scales", np.inf, "scales must be finite"),
        ("opacities", -0.1, r"opacities must lie in 0\.\.1e\+06; Gaussian 1"),
        ("opacities", 2e6, r"opacities must lie in 0\.\.1e\+06"),
        ("quaternions", 3.0, "quaternions must have length 1; Gaussian 1"),
    ],
)
def test_validate_names_what_is_wrong(field, value, message):
    bad = scene()
    getattr(bad, field)[1] = value
    with pytest.raises(InputError, match=message):
        bad.validate("test")


def test_validate_refuses_wrong_shapes_and_types():
    good = scene()
    with pytest.raises(InputError, match=r"scales must have shape \(3, 3\), not \(2, 3\)"):
        Scene(good.means, good.quaternions, good.scales[:2], good.opacities, good.sh).validate()
    with pytest.raises(InputError, match="opacities must be float32, not float64"):
        Scene(
            good.means, good.quaternions, good.scales, good.opacities.astype(float), good.sh
        ).validate()
    with pytest.raises(InputError, match="sh must hold 1, 4, 9 or 16 coefficients, not 5"):
        scene(coefficients=5).validate()


def test_zero_scale_opacity_above_one_and_no_splats_are_allowed():
    flat = scene()
    flat.scales[:] = 0
    flat.opacities[:] = 44
    flat.validate()
    assert len(scene(0).validate()) == 0


def test_concatenate_pads_harmonics_and_keeps_order():
    both = concatenate([scene(2, 1), scene(3, 9)]).validate()
    assert len(both) == 5 and both.sh_degree == 2
    assert np.array_equal(both.means[2:], scene(3).means)


def test_scaled_changes_lengths_only():
    doubled = scene().scaled(2.0)
    assert np.array_equal(doubled.means, scene().means * 2)
    assert np.array_equal(doubled.scales, scene().scales * np.float32(2))
    assert np.array_equal(doubled.opacities, scene().opacities)
    with pytest.raises(InputError, match="scale factor must be a positive number, not 0"):
        scene().scaled(0)


def test_normalised_quaternions_refuse_zero_length():
    q = normalised_quaternions(np.array([[2.0, 0, 0, 0], [1, 1, 1, 1]]))
    assert np.array_equal(q, np.float32([[1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5]]))
    with pytest.raises(InputError, match="file: quaternion 1 must not have length 0"):
        normalised_quaternions(np.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]), "file")
