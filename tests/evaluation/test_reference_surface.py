# SPDX-License-Identifier: Apache-2.0
"""Thinning and visibility."""

import numpy as np
from scenes import plane

from vitamin3d.evaluation.reference_surface import observed_by, thinned, voxel_keys
from vitamin3d.geometry.cameras import PinholeCamera

CAMERA = PinholeCamera(100.0, 100.0, 49.5, 39.5, 100, 80)


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
