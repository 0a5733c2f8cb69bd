# SPDX-License-Identifier: Apache-2.0
"""Normal maps: of a keyframe's depth view, or cast from a mesh (the paper's Fig. 3d)."""

from pathlib import Path

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.exporters.depth_map import write_png
from vitamin3d.geometry.cameras import Camera
from vitamin3d.types import Array, Surface

RED_GREEN_BLUE = np.array([1.0, -1.0, -1.0])
"""Camera right -> red, up -> green, towards the camera -> blue: a wall that faces the camera is light violet."""


def write_normal_map(normals: Array, path: Path, R_frame_cam: Array | None = None) -> None:
    """Unit normals (H, W, 3) in the camera frame as an 8-bit RGB PNG.

    Args:
        normals: 0 where there is none, which becomes black.
        R_frame_cam: (3, 3) rotation into another frame (the world, say), whose x, y, z become red, green and blue;
            None: the camera's right, up and backwards do.

    Raises:
        OutputError: the file cannot be written.
    """
    write_png(rgb_from_normals(normals, R_frame_cam), path)


def rgb_from_normals(normals: Array, R_frame_cam: Array | None = None) -> Array:
    """(H, W, 3) uint8 RGB `(n + 1) / 2` of normals (H, W, 3), 0 where there is none; see `write_normal_map`."""
    to_rgb = np.diag(RED_GREEN_BLUE) if R_frame_cam is None else R_frame_cam
    normals, rgb = np.ascontiguousarray(normals, np.float32), np.empty(normals.shape, np.uint8)
    _paint(normals.reshape(-1, 3), np.ascontiguousarray(to_rgb, np.float64), rgb.reshape(-1, 3))
    return rgb


@kernel
def _paint(normals, to_rgb, rgb):  # type: ignore[no-untyped-def]
    for n in range(normals.shape[0]):
        x, y, z = normals[n, 0], normals[n, 1], normals[n, 2]
        for c in range(3):
            turned = to_rgb[c, 0] * x + to_rgb[c, 1] * y + to_rgb[c, 2] * z
            rgb[n, c] = np.uint8(np.rint(127.5 * (min(max(turned, -1.0), 1.0) + 1.0)))
        if x == 0.0 and y == 0.0 and z == 0.0:
            rgb[n, 0], rgb[n, 1], rgb[n, 2] = 0, 0, 0


def cast_normal_map(surface: Surface, camera: Camera, T_cam_world: Array) -> Array:
    """Normals (H, W, 3) float32 in the camera frame, towards the camera, of the mesh as a pinhole camera sees it; 0 = none.

    The camera's distortion is not used: give the canvas. To cast many maps of one mesh, keep a `NormalCaster`.
    """
    return NormalCaster(surface).cast(camera, T_cam_world)


class NormalCaster:
    """A mesh ready for casting (Open3D's RaycastingScene); the vertex normals are interpolated."""

    def __init__(self, surface: Surface) -> None:
        import open3d as o3d

        self._surface = surface
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(surface.vertices_world.astype(np.float32)), o3d.core.Tensor(surface.triangles.astype(np.uint32))
        )

    def cast(self, camera: Camera, T_cam_world: Array) -> Array:
        """Normals (H, W, 3) float32; see `cast_normal_map`."""
        hit, corners, uv, _ = self._hits(camera, T_cam_world)
        normals = np.zeros((camera.height, camera.width, 3), np.float32)
        mixed = _interpolated(self._surface.normals_world, corners, uv)
        seen = mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12) @ T_cam_world[:3, :3].T
        normals[hit] = seen * _towards_camera(seen, camera, hit)[:, None]
        return normals

    def cast_colors(self, camera: Camera, T_cam_world: Array) -> Array:
        """Vertex colours (H, W, 3) float32, 0–255, interpolated; 0 where the mesh is not."""
        hit, corners, uv, _ = self._hits(camera, T_cam_world)
        colors = np.zeros((camera.height, camera.width, 3), np.float32)
        colors[hit] = _interpolated(self._surface.colors.astype(np.float32), corners, uv)
        return colors

    def median_depth(self, camera: Camera, T_cam_world: Array) -> float:
        """Median depth along z of what the camera sees of the mesh; 1 where it sees nothing."""
        *_, depths = self._hits(camera, T_cam_world)
        return float(np.median(depths)) if len(depths) else 1.0

    def _hits(self, camera: Camera, T_cam_world: Array) -> tuple[Array, Array, Array, Array]:
        """Which pixels (H, W) hit; per hit the triangle's corners (N, 3), barycentric uv (N, 2) and depth along z (N,)."""
        import open3d as o3d

        hits = self._scene.cast_rays(o3d.core.Tensor(_rays_world(camera, T_cam_world)))
        depth = hits["t_hit"].numpy()
        hit = np.isfinite(depth)
        corners = self._surface.triangles[hits["primitive_ids"].numpy()[hit]]
        return hit, corners, hits["primitive_uvs"].numpy()[hit], depth[hit]


def _interpolated(values: Array, corners: Array, uv: Array) -> Array:
    """Values (N, C) at the barycentric `uv` (N, 2) of triangles (N, 3)."""
    a, b, c = (values[corners[:, k]] for k in range(3))
    return np.asarray((1.0 - uv.sum(axis=1, keepdims=True)) * a + uv[:, :1] * b + uv[:, 1:] * c)


def _rays_world(camera: Camera, T_cam_world: Array) -> Array:
    """(H, W, 6) float32 camera centre and direction of each pixel, in the world, as Open3D casts them."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    directions = camera.rays_from_ideal(np.stack([u.ravel(), v.ravel()], axis=1)) @ T_cam_world[:3, :3]
    center = np.broadcast_to(-T_cam_world[:3, :3].T @ T_cam_world[:3, 3], directions.shape)
    return np.hstack([center, directions]).astype(np.float32).reshape(camera.height, camera.width, 6)


def _towards_camera(normals: Array, camera: Camera, hit: Array) -> Array:
    """(N,) 1 or -1: the sign that turns each normal of the pixels `hit` (H, W) to the camera."""
    v, u = np.nonzero(hit)
    rays = camera.rays_from_ideal(np.stack([u, v], axis=1).astype(np.float64))
    return np.where((normals * rays).sum(axis=1) > 0, -1.0, 1.0)
