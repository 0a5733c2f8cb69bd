# SPDX-License-Identifier: Apache-2.0
"""Density and coverage on shapes whose figures can be said by hand."""

import numpy as np
import pytest
from scenes import plane

from vitamin3d.datasets.point_files import NO_TRIANGLES, Geometry
from vitamin3d.evaluation.cloud_statistics import coverage_of_truth, coverage_of_voxels, density, mutual, points_per_area
from vitamin3d.evaluation.surface_error import sample_surface


def square(z=0.0):
    return Geometry(np.array([[0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]], float), np.array([[0, 1, 2], [0, 2, 3]]))


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
