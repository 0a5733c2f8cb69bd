# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import reference_dense as reference

from vitamin3d.exporters.depth_map import counts_from_depth
from vitamin3d.exporters.normal_map import cast_normal_map, rgb_from_normals, write_normal_map
from vitamin3d.geometry.se3 import exp_se3

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


def test_colours_of_normals():
    normals = np.array([[[0, 0, -1], [1, 0, 0], [0, -1, 0], [0, 0, 0]]], np.float32)
    assert rgb_from_normals(normals).tolist() == [[[128, 128, 255], [255, 128, 128], [128, 255, 128], [0, 0, 0]]]
    to_world = exp_se3(np.array([0, 0, 0, 0, np.pi / 2, 0]))[:3, :3]  # camera z is world x
    np.testing.assert_allclose(rgb_from_normals(normals, to_world)[0, 0], [0, 128, 128], atol=1)


def test_maps_equal_the_formulas():
    rng = np.random.default_rng(0)
    normals, turn = rng.normal(size=(20, 30, 3)).astype(np.float32), exp_se3(np.array([0, 0, 0, 0.3, -0.8, 0.2]))[:3, :3]
    expected = np.rint(127.5 * (np.clip(normals @ turn.T, -1, 1) + 1))
    assert np.abs(rgb_from_normals(normals, turn) - expected).max() == 0
    depth = rng.uniform(-1, 80, (20, 30)).astype(np.float32)
    counts = np.rint(depth.astype(float) * 1234.5)
    np.testing.assert_array_equal(counts_from_depth(depth, 1234.5), np.where((counts >= 0) & (counts < 65536), counts, 0))


def test_normal_maps_are_rgb_files(tmp_path):
    import cv2

    write_normal_map(np.array([[[0, 0, -1.0]]]), tmp_path / "n.png")
    assert cv2.imread(str(tmp_path / "n.png"))[0, 0].tolist() == [255, 128, 128]  # OpenCV reads BGR


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_cast_normals_face_the_camera_at_the_pixels_of_the_mesh(surface, flip):
    surface.normals_world[:] *= flip
    T_cam_world = exp_se3(np.array([0.03, 0.02, 0.1, 0.1, 0.2, 0.3]))
    normals = cast_normal_map(surface, reference.SMALL, T_cam_world)
    pixels = np.argwhere((normals != 0).any(axis=2))[:, ::-1].astype(float)
    rays = reference.SMALL.rays_from_ideal(pixels) @ T_cam_world[:3, :3]
    center = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]
    hits = center + rays * ((2.0 - center[2]) / rays[:, 2])[:, None]
    assert np.abs(hits[:, :2]).max() < 1.0 + 1e-5 and len(hits) > 1000
    np.testing.assert_allclose(normals[(normals != 0).any(axis=2)] @ T_cam_world[:3, :3], np.tile([0.0, 0, -1], (len(hits), 1)), atol=1e-5)
