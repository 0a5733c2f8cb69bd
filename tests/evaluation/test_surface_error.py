# SPDX-License-Identifier: Apache-2.0
"""Surface errors on shapes whose figures can be said by hand."""

import numpy as np
import pytest
from scenes import plane, room

from vitamin3d.datasets.point_files import Geometry
from vitamin3d.errors import InputError
from vitamin3d.evaluation.reference_surface import thinned
from vitamin3d.evaluation.surface_error import nearest, refined, sample_surface, surface_errors
from vitamin3d.geometry.se3 import exp_so3


def test_a_shifted_plane_has_the_shift_as_its_error():
    errors = surface_errors(plane(z=0.03), plane())
    for value in (errors.accuracy_median, errors.accuracy_mean, errors.accuracy_rmse, errors.completion_mean, errors.chamfer):
        assert value == pytest.approx(0.03, rel=1e-6)
    assert (errors.rmse_accuracy, errors.rmse_completion, errors.rmse_chamfer) == pytest.approx((0.03, 0.03, 0.03))
    assert (errors.accuracy_within_5cm, errors.completeness_5cm, errors.unobserved) == (1.0, 1.0, 0.0)


def test_half_a_plane_covers_half():
    full = plane()
    half = full[full[:, 0] <= 0.5]
    errors = surface_errors(half, full)
    assert errors.accuracy_median == 0 and errors.completeness_5cm == pytest.approx(0.55, abs=0.01)
    assert errors.completeness_10cm == pytest.approx(0.60, abs=0.011)
    assert errors.rmse_completion == pytest.approx(np.sqrt((np.maximum(0, full[:, 0] - 0.5) ** 2)[full[:, 0] < 0.999].mean()), rel=0.02)


def test_what_nobody_saw_is_no_error_but_is_counted():
    errors = surface_errors(np.vstack([plane(z=0.01), plane(z=1.0)]), plane())
    assert errors.unobserved == 0.5 and errors.accuracy_median == pytest.approx(0.01) and errors.rmse_accuracy == pytest.approx(0.01)
    nothing = surface_errors(plane(z=5.0), plane())
    assert np.isnan(nothing.accuracy_median) and nothing.completion_mean == 1.0 and np.isnan(nothing.rmse_chamfer)


def test_meshes_are_sampled_by_area(rng):
    mesh = Geometry(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [8, 0, 0], [5, 3, 0.0]]), np.array([[0, 1, 2], [3, 4, 5]]))
    samples = sample_surface(mesh, 10_000)
    large = samples[:, 0] >= 5
    assert large.mean() == pytest.approx(0.9, abs=0.01)
    np.testing.assert_allclose(samples[large].mean(axis=0), [6, 1, 0], atol=0.05)
    np.testing.assert_array_equal(samples, sample_surface(mesh, 10_000))
    with pytest.raises(InputError, match="without area"):
        sample_surface(Geometry(np.zeros((3, 3)), np.array([[0, 1, 2]])))


def test_a_small_misalignment_is_taken_out_and_a_large_one_is_not(rng):
    truth = thinned(room(rng), 0.02)
    moved = 1.005 * truth @ exp_so3(np.array([0.002, 0.003, -0.001])).T + [0.01, -0.02, 0.01]
    after, (s, R, t) = refined(moved, truth)
    assert nearest(after, truth).mean() < 0.3 * nearest(moved, truth).mean()
    np.testing.assert_allclose(s * moved @ R.T + t, after, atol=1e-9)
    far = truth + np.array([0.0, 0.0, 3.0])
    np.testing.assert_allclose(refined(far, truth)[0], far, atol=0.3)
