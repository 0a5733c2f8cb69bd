# SPDX-License-Identifier: Apache-2.0
"""Surface errors, registration, density and rendering on shapes whose figures can be said by hand."""

import numpy as np
import pytest

from vitamin3d.datasets.point_files import NO_TRIANGLES, Geometry
from vitamin3d.errors import InputError
from vitamin3d.evaluation.cloud_statistics import coverage_of_truth, coverage_of_voxels, density, mutual, points_per_area
from vitamin3d.evaluation.reference_surface import observed_by, thinned, voxel_keys
from vitamin3d.evaluation.registration import register
from vitamin3d.evaluation.surface_error import nearest, refined, sample_surface, surface_errors
from vitamin3d.exporters.rendering import draw_points, side_by_side
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.se3 import exp_so3

CAMERA = Camera(100.0, 100.0, 49.5, 39.5, 100, 80)


def plane(side=1.0, step=0.01, z=0.0):
    x, y = np.meshgrid(np.arange(0, side + 1e-9, step), np.arange(0, side + 1e-9, step))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def square(z=0.0):
    return Geometry(np.array([[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]], float), np.array([[0, 1, 2], [0, 2, 3]]))


def room(rng, count=4000):
    """Points on three walls and a box: no symmetry."""
    a = rng.random((count, 2))
    walls = [np.column_stack([4 * a[:, 0], 3 * a[:, 1], 0 * a[:, 0]]), np.column_stack([0 * a[:, 0], 3 * a[:, 0], 2 * a[:, 1]])]
    box = np.array([1.0, 0.8, 0.0]) + np.column_stack([0.7 * a[:, 0], 0.5 * a[:, 1], np.full(count, 0.6)])
    return np.vstack([*walls, box])


# --- errors ----------------------------------------------------------------------------------------------------------


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


# --- thinning and visibility -----------------------------------------------------------------------------------------


def test_thinning_takes_the_mean_of_each_voxel(rng):
    points = rng.uniform(-1, 1, (2000, 3))
    cells = np.floor((points - points.min(axis=0)) / 0.3 + 0.5).astype(int)
    unique, inverse = np.unique(cells, axis=0, return_inverse=True)
    expected = np.array([points[inverse.ravel() == k].mean(axis=0) for k in range(len(unique))])
    found = thinned(points, 0.3)
    assert len(found) == len(unique)
    assert len(np.unique(voxel_keys(points, 0.3))) == len(np.unique(np.floor(points / 0.3), axis=0))
    np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)], atol=1e-12)
    import open3d as o3d

    theirs = np.asarray(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(0.3).points)
    np.testing.assert_allclose(found[np.lexsort(found.T)], theirs[np.lexsort(theirs.T)], atol=1e-12)


def test_only_what_is_in_the_picture_and_not_hidden_is_observed():
    front = plane(0.4, 0.02, 2.0) - [0.2, 0.2, 0]
    behind, aside, back = front + np.array([0, 0, 1.0]), front + np.array([3.0, 0, 0]), front * [1, 1, -1]
    seen = observed_by(np.vstack([front, behind, aside, back]), np.eye(4)[None], CAMERA)
    parts = np.split(seen, 4)
    assert parts[0].all() and parts[1].mean() < 0.75 and not parts[2].any() and not parts[3].any()
    moved = np.eye(4)
    moved[0, 3] = 3.0
    assert np.split(observed_by(np.vstack([front, aside]), np.stack([np.eye(4), moved]), CAMERA), 2)[1].all()


# --- registration ----------------------------------------------------------------------------------------------------


def test_a_cloud_is_found_in_any_scale_and_frame(rng, scale=7.0):
    target = room(rng)
    R = exp_so3(rng.standard_normal(3) * 2)
    some = target[rng.random(len(target)) < 0.3] + 0.005 * rng.standard_normal((1, 3))
    source = ((some - [1, 2, 3]) @ R + 0.004 * rng.standard_normal(some.shape)) * scale
    found = register(source, target)
    assert found.holds and found.scale == pytest.approx(1 / scale, rel=0.02)
    assert np.median(np.linalg.norm(found.apply(source) - some, axis=1)) < 0.05
    again = register(source, target)
    assert (again.scale, again.overlap) == (found.scale, found.overlap)


def test_unrelated_clouds_are_not_registered(rng):
    found = register(rng.standard_normal((2000, 3)), room(rng))
    assert not found.holds
    with pytest.raises(InputError, match="at least 20 points"):
        register(np.zeros((5, 3)), room(rng))


# --- density and coverage --------------------------------------------------------------------------------------------


def test_density_of_a_grid_and_of_a_mesh():
    assert points_per_area(plane()) == pytest.approx(10_000, rel=0.35)
    assert np.isnan(points_per_area(np.zeros((3, 3))))
    found = density(square(0.01), sample_surface(square(0.01), 50_000))
    assert (found.points, found.area_m2, found.points_per_m2) == (4, 1.0, 4.0)
    assert found.voxels == {"2": 2500, "5": 400, "10": 100}
    assert np.isnan(density(Geometry(plane(), NO_TRIANGLES), plane()).area_m2)


def test_coverage_by_hand():
    full = plane(z=0.05)
    left, right = full[full[:, 0] <= 0.55], full[full[:, 0] >= 0.45]
    found = coverage_of_truth(left, right, full)
    assert found.its_only == pytest.approx(0.40, abs=0.011) and found.ours_only == pytest.approx(0.40, abs=0.011)
    assert found.both + found.its_only + found.ours_only == pytest.approx(1.0)
    cells = coverage_of_voxels(left, right + np.array([0, 0, 5.0]))
    assert cells.both == 0 and cells.its_only == pytest.approx(0.5, abs=0.06)
    assert coverage_of_voxels(full, full).both == 1.0
    both = mutual(plane(z=0.02), plane())
    assert (both.its_median, both.ours_median, both.its_within_5cm) == pytest.approx((0.02, 0.02, 1.0))


# --- pictures --------------------------------------------------------------------------------------------------------


def test_the_nearest_point_is_in_front():
    points, colors = (
        np.array([[0, 0, 4.0], [0, 0, 2.0], [0.5, 0, 2.0], [0, 0, -1]]),
        np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]]),
    )
    for order in ([0, 1, 2, 3], [1, 0, 3, 2]):
        picture = draw_points(points[order], colors[order].astype(np.uint8), CAMERA, np.eye(4), 1.5)
        assert picture.shape == (80, 100, 3)
        assert picture[40, 50].tolist() == [0, 255, 0] and picture[40, 75].tolist() == [0, 0, 255]
        assert (picture != 255).any(axis=-1).sum() == 18  # two discs of nine pixels: the third is hidden
    assert (draw_points(np.zeros((0, 3)), None, CAMERA, np.eye(4)) == 255).all()


def test_panels_are_laid_out_in_rows():
    panels = [np.full((20, 60, 3), k * 40, np.uint8) for k in range(4)]
    page = side_by_side(panels, list("abcd"), columns=3)
    assert page.shape == (2 * (20 + 26 + 6) - 6, 3 * 66 - 6, 3)
    assert page[30, 70].tolist() == [40] * 3 and page[-10, 10].tolist() == [120] * 3 and page[-10, 100].tolist() == [255] * 3
