# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.errors import InputError
from vitamin3d.geometry.se3 import exp_se3
from vitamin3d.scale import Scale, match_timestamps, scale_from_ground_truth
from vitamin3d.types import PointCloud, Surface, Trajectory

MS = 1_000_000


def trajectory(count=30, offset_ns=0):
    poses = np.array([exp_se3(np.array([0.1 * k, np.sin(0.3 * k), 0.2 * np.cos(k), 0.01 * k, 0, 0])) for k in range(count)])
    return Trajectory(np.arange(count, dtype=np.int64) * 50 * MS + offset_ns, poses)


def test_an_unknown_scale_says_so_and_changes_nothing():
    scale, path = Scale(), trajectory()
    assert not scale.is_known and scale.unit == "map unit" and "up to scale" in scale.remark
    np.testing.assert_array_equal(scale.trajectory(path).T_world_cam, path.T_world_cam)


def test_a_known_scale_makes_metres():
    scale, path = Scale(2.5, "given"), trajectory()
    scaled = scale.trajectory(path)
    assert scale.is_known and scale.unit == "metre" and "2.5 metres per map unit, given" in scale.remark
    np.testing.assert_allclose(scaled.T_world_cam[:, :3, 3], 2.5 * path.T_world_cam[:, :3, 3])
    np.testing.assert_array_equal(scaled.T_world_cam[:, :3, :3], path.T_world_cam[:, :3, :3])
    np.testing.assert_array_equal(scaled.timestamps_ns, path.timestamps_ns)
    assert scale.units(5.0) == 2.0 and scale.units(None) is None
    np.testing.assert_array_equal(path.T_world_cam, trajectory().T_world_cam)  # the input is left alone


def test_surface_and_cloud_are_scaled_and_keep_the_rest(rng):
    vertices, normals, colors = rng.standard_normal((5, 3)), rng.standard_normal((5, 3)), np.zeros((5, 3), np.uint8)
    scaled = Scale(3.0, "given").surface(Surface(vertices, np.array([[0, 1, 2]], np.int32), normals, colors))
    np.testing.assert_allclose(scaled.vertices_world, 3 * vertices)
    np.testing.assert_array_equal(scaled.normals_world, normals)
    quality = [rng.random(5) for _ in range(4)]
    cloud = Scale(3.0, "given").cloud(PointCloud(vertices, colors, *quality))
    np.testing.assert_allclose(cloud.points_world, 3 * vertices)
    np.testing.assert_array_equal([cloud.num_observations, cloud.parallax_deg, cloud.reprojection_rms_px, cloud.depth_deviation], quality)


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (1, 1), (1, 7), (7, 1), (40, 25), (25, 40)])
def test_matching_equals_its_twin(rng, n, m):
    for _ in range(5):
        a, b = (np.unique(rng.integers(0, 1000, count)) * MS for count in (n, m))
        pairs = []
        for i, x in enumerate(a):
            j = min(range(len(b)), key=lambda j: (abs(int(b[j]) - int(x)), j), default=None)
            if j is not None and abs(int(b[j]) - int(x)) <= 20 * MS:
                pairs.append((i, j))
        found = list(zip(*(rows.tolist() for rows in match_timestamps(a, b)), strict=True))
        assert found == pairs


def test_the_tolerance_is_inclusive():
    assert [len(match_timestamps(np.array([0]), np.array([t * MS]))[0]) for t in (19, 20, 21)] == [1, 1, 0]


def test_scale_comes_out_of_a_moved_turned_and_late_truth(rng):
    path = trajectory()
    T = exp_se3(np.array([5.0, -3, 1, 0.3, 0.9, -2]))
    truth = Trajectory(path.timestamps_ns + 7 * MS, T @ Scale(4.2, "x").trajectory(path).T_world_cam)
    scale = scale_from_ground_truth(path, truth)
    assert scale.metres_per_unit == pytest.approx(4.2, rel=1e-9) and scale.source == "ground truth"


@pytest.mark.parametrize(
    ("truth", "words"),
    [(None, "has no ground truth"), (trajectory(9), "only 9 poses"), (trajectory(30, 10**12), "only 0 poses")],
)
def test_scale_without_a_usable_truth_is_refused(truth, words):
    with pytest.raises(InputError, match=words):
        scale_from_ground_truth(trajectory(), truth)


def test_a_standing_trajectory_has_no_scale():
    standing = Trajectory(trajectory().timestamps_ns, np.broadcast_to(np.eye(4), (30, 4, 4)))
    with pytest.raises(InputError, match="moves"):
        scale_from_ground_truth(standing, trajectory())
