# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference
from scipy.spatial import cKDTree

from vitamin3d.dense import tsdf_fusion
from vitamin3d.dense.tsdf_fusion import BACKENDS, Limits, TsdfVolume, certain_depth, check_backend, empty_surface
from vitamin3d.errors import DependencyError, InputError
from vitamin3d.geometry.se3 import exp_se3, inverse, transform_points
from vitamin3d.types import DepthView

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")
CAMERA = reference.SMALL
VOXEL = 0.03
LIMITS = Limits(1e3, 1e3)


def view_of_sphere(T_cam_world, unit=1.0, wall=2.0):
    """A sphere of radius 0.3 around (0, 0, 1.2) before a wall at z = `wall`, both in the world; in map units of `unit`."""
    grid = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), -1).reshape(-1, 2).astype(float)
    rays, T_world_cam = CAMERA.rays_from_ideal(grid), inverse(T_cam_world)
    directions, origin = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    to_wall = (wall - origin[2]) / directions[:, 2]
    offset = origin - [0, 0, 1.2]
    a, b, c = (directions**2).sum(1), directions @ offset, offset @ offset - 0.09
    root = np.sqrt(np.maximum(b * b - a * c, 0))
    depth = np.where(b * b > a * c, (-b - root) / a, to_wall).reshape(CAMERA.height, CAMERA.width)
    color = np.zeros((*depth.shape, 3), np.uint8)
    color[...] = [200, 100, 50]
    T = T_cam_world.copy()
    T[:3, 3] *= unit
    return DepthView(0, T, (unit * depth).astype(np.float32), np.zeros(color.shape, np.float32), color, np.ones(depth.shape, np.float32))


def fused(backend, unit=1.0, max_depth=5.0, poses=((0, 0, 0), (0.2, 0, 0), (0, -0.2, 0.1))):
    volume = TsdfVolume(VOXEL * unit, 4 * VOXEL * unit, LIMITS, backend)
    for x, y, z in poses:
        T_world_cam = exp_se3(np.array([x, y, z, 0.2 * y, -0.2 * x, 0.05]))
        volume.integrate(view_of_sphere(inverse(T_world_cam), unit), CAMERA, max_depth * unit)
    return volume.extract_surface()


def distances_to_surface(points, surface):
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(surface.vertices_world.astype(np.float32)), o3d.core.Tensor(surface.triangles.astype(np.uint32)))
    return scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def to_truth(points):
    sphere = np.abs(np.linalg.norm(points - [0, 0, 1.2], axis=1) - 0.3)
    return np.minimum(sphere, np.abs(points[:, 2] - 2.0))


@pytest.mark.parametrize("backend", list(BACKENDS))
def test_surface_is_the_truth_and_faces_the_cameras(backend):
    surface = fused(backend)
    errors = to_truth(surface.vertices_world)
    assert len(surface.triangles) > 3000 and 0 < np.median(errors) < 0.1 * VOXEL
    a, b, c = (surface.vertices_world[surface.triangles[:, k]] for k in range(3))
    on_wall = a[:, 2] > 1.95
    normals = np.cross(b - a, c - a)[on_wall]
    assert (normals[:, 2] <= 0).mean() > 0.95
    assert surface.colors.dtype == np.uint8 and np.abs(np.median(surface.colors, axis=0) - [200, 100, 50]).max() <= 1


@pytest.mark.parametrize("backend", [name for name in BACKENDS if name != "scalable"])
def test_backends_agree_to_a_fraction_of_a_voxel(backend):
    one, other = fused(backend), fused("scalable")
    for a, b in ((one, other), (other, one)):
        distances = distances_to_surface(a.vertices_world, b)
        assert np.median(distances) < 0.05 * VOXEL
        assert np.quantile(distances, 0.8) < 0.1 * VOXEL
        assert np.quantile(distances, 0.99) < 0.8 * VOXEL  # borders and silhouettes lie half a voxel apart


@pytest.mark.parametrize("backend", list(BACKENDS))
def test_the_map_unit_does_not_matter(backend):
    metres, small = fused(backend), fused(backend, unit=0.01)
    assert len(small.vertices_world) == pytest.approx(len(metres.vertices_world), rel=0.03)
    assert np.median(to_truth(100.0 * small.vertices_world)) < 0.1 * VOXEL


@pytest.mark.parametrize("backend", list(BACKENDS))
def test_what_is_too_far_is_not_fused(backend):
    assert fused(backend, max_depth=1.7).vertices_world[:, 2].max() < 1.6


def test_what_is_too_uncertain_for_its_depth_is_not_fused():
    view = view_of_sphere(np.eye(4))  # the sphere is nearer than 1.5, the wall at 2, both known to 0.05
    view = dataclasses.replace(view, weights=np.full_like(view.depth, 0.05**-2))
    volume = TsdfVolume(VOXEL, 4 * VOXEL, Limits(0.03, 1e3), "scalable")
    volume.integrate(view, CAMERA, 5.0)
    far = volume.extract_surface().vertices_world
    assert len(far) > 500 and far[:, 2].min() > 1.8


def test_certain_depth():
    rng = np.random.default_rng(0)
    depth, deviations = rng.uniform(0, 4, (20, 30)).astype(np.float32), rng.uniform(0.01, 0.2, (20, 30))
    depth[:3] = 0.0
    view = dataclasses.replace(view_of_sphere(np.eye(4)), depth=depth, weights=(deviations**-2).astype(np.float32))
    expected = [
        [z if 0 < z < 3.0 and s / z <= 0.05 else 0.0 for z, s in zip(*row, strict=True)] for row in zip(depth, deviations, strict=True)
    ]
    np.testing.assert_array_equal(certain_depth(view, 0.05, 3.0), np.array(expected, np.float32))
    assert 50 < np.count_nonzero(expected) < 500


@pytest.mark.parametrize("backend", list(BACKENDS))
def test_the_order_of_the_views_does_not_matter(backend):
    poses = ((0, 0, 0), (0.2, 0, 0), (0, -0.2, 0.1))
    one, other = fused(backend, poses=poses).vertices_world, fused(backend, poses=poses[::-1]).vertices_world
    assert len(one) == pytest.approx(len(other), rel=2e-3)
    for a, b in ((one, other), (other, one)):
        assert np.quantile(cKDTree(b).query(a)[0], 0.99) < 0.02 * VOXEL


@pytest.mark.parametrize("backend", list(BACKENDS))
def test_extrinsics_are_camera_from_world(backend):
    T_world_cam = exp_se3(np.array([0.5, -0.4, 0.3, 0.1, 1.2, -0.7]))
    volume = TsdfVolume(VOXEL, 4 * VOXEL, LIMITS, backend)
    depth = np.full((CAMERA.height, CAMERA.width), 1.5, np.float32)
    color = np.zeros((*depth.shape, 3), np.uint8)
    volume.integrate(DepthView(0, inverse(T_world_cam), depth, color.astype(np.float32), color, np.ones_like(depth)), CAMERA, 3.0)
    points_cam = transform_points(inverse(T_world_cam), volume.extract_surface().vertices_world)
    assert np.quantile(np.abs(points_cam[:, 2] - 1.5), 0.95) < 0.2 * VOXEL


@pytest.mark.parametrize("backend", list(BACKENDS))
def test_an_empty_volume_has_an_empty_surface(backend):
    volume = TsdfVolume(VOXEL, 4 * VOXEL, LIMITS, backend)
    nothing = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    zeros = nothing[..., 0].astype(np.float32)
    volume.integrate(DepthView(0, np.eye(4), zeros, nothing.astype(np.float32), nothing, zeros), CAMERA, 2.0)
    surface = volume.extract_surface()
    assert surface.vertices_world.shape == (0, 3) and surface.triangles.shape == (0, 3)


def test_an_open3d_that_fuses_nothing_is_refused(monkeypatch):
    class Dead:
        def __init__(self, voxel_length, truncation, limits): ...

        def integrate(self, view, canvas, max_depth): ...

        def extract_surface(self):
            return empty_surface()

    monkeypatch.setitem(tsdf_fusion.BACKENDS, "dead", Dead)
    with pytest.raises(DependencyError, match=r"open3d<0\.20"):
        check_backend("dead")


def test_unknown_backends_are_refused():
    with pytest.raises(InputError, match="scalable, blocks"):
        TsdfVolume(0.1, 0.4, LIMITS, "octree")
