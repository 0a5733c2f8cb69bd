# SPDX-License-Identifier: Apache-2.0
"""Depth views -> a truncated signed distance field -> a mesh (Sec. 4.2, "Mesh Integration in TSDF"; Curless and Levoy 1996)."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.dense.block_volume import BlockVolume
from vitamin3d.errors import DependencyError, InputError
from vitamin3d.geometry.cameras import Camera, PinholeCamera
from vitamin3d.types import Array, DepthView, Surface

BLOCK_RESOLUTION = 16
"""Voxels along the side of a block of Open3D's volume."""
ALLOCATION_STRIDE = 8
"""Open3D's volume allocates for every so many-th pixel in both directions; a fine block is some hundred of them wide."""


@dataclass(frozen=True)
class Limits:
    """What is too uncertain to be fused."""

    relative_deviation: float
    """Of a pixel's depth over the depth; beyond it Open3D's volume, which knows no weights, does not get the pixel."""
    surface_deviation: float
    """Map units; the surface of `blocks` ends where all views together know it worse than this."""


class TsdfVolume:
    """A volume that depth views are averaged into; coarse and fine are two instances.

    Args:
        voxel_length: map units.
        truncation: map units; distances are kept up to this far from a surface.
        limits: what is too uncertain to be fused.
        backend: `scalable` (Open3D's ScalableTSDFVolume, in which all pixels weigh the same) or `blocks` (ours; every pixel has its
            weight, and views can be taken out again).

    Raises:
        InputError: no such backend.
        DependencyError: the installed Open3D fuses nothing.
    """

    def __init__(self, voxel_length: float, truncation: float, limits: Limits, backend: str = "scalable") -> None:
        if backend not in BACKENDS:
            raise InputError(f"fusion.backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
        check_backend(backend)
        self.voxel_length = voxel_length
        self._volume = BACKENDS[backend](voxel_length, truncation, limits)

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        """Averages a view, drawn on `canvas`, into the volume; depths beyond `max_depth` (map units) are left out."""
        if ((view.depth > 0) & (view.depth < max_depth)).any():
            self._volume.integrate(view, canvas, max_depth)

    def remove(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        """Takes a view out that was integrated just so; its pose and pixels must be the same.

        Raises:
            InputError: the backend cannot.
        """
        if not isinstance(self._volume, _WeightedBlocks):
            raise InputError('only fusion.backend = "blocks" can take views out again')
        self._volume.remove(view, canvas, max_depth)

    def size(self) -> dict[str, int] | None:
        """Blocks in use and bytes of them all; None where Open3D does not say."""
        return self._volume.size()

    def extract_surface(self) -> Surface:
        """The zero level (marching cubes), triangles facing the cameras; vertex normals are not filled in yet (zero)."""
        return self._volume.extract_surface()


class _ScalableVolume:
    """Open3D's ScalableTSDFVolume, with its own marching cubes."""

    def __init__(self, voxel_length: float, truncation: float, limits: Limits) -> None:
        import open3d as o3d

        self._limits = limits
        self._volume = o3d.pipelines.integration.ScalableTSDFVolume(
            voxel_length=voxel_length,
            sdf_trunc=truncation,
            color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
            volume_unit_resolution=BLOCK_RESOLUTION,
            depth_sampling_stride=ALLOCATION_STRIDE,
        )

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        import open3d as o3d

        rgbd = o3d.geometry.RGBDImage()
        rgbd.color = o3d.geometry.Image(np.ascontiguousarray(view.color))
        rgbd.depth = o3d.geometry.Image(certain_depth(view, self._limits.relative_deviation, max_depth))
        pinhole = o3d.camera.PinholeCameraIntrinsic(canvas.width, canvas.height, *canvas.intrinsics)
        self._volume.integrate(rgbd, pinhole, view.T_cam_world)

    def size(self) -> dict[str, int] | None:
        return None

    def extract_surface(self) -> Surface:
        mesh = self._volume.extract_triangle_mesh()
        return _surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles), np.asarray(mesh.vertex_colors))


class _WeightedBlocks:
    """Our blocks of voxels."""

    def __init__(self, voxel_length: float, truncation: float, limits: Limits) -> None:
        self._volume = BlockVolume(voxel_length, truncation, limits.surface_deviation)

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        self._volume.integrate(view, canvas, max_depth)

    def remove(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        self._volume.remove(view, canvas, max_depth)

    def size(self) -> dict[str, int] | None:
        return {"blocks": self._volume.num_blocks, "bytes": self._volume.num_bytes}

    def extract_surface(self) -> Surface:
        return _surface(*self._volume.extract())


BACKENDS: dict[str, type[_ScalableVolume] | type[_WeightedBlocks]] = {"scalable": _ScalableVolume, "blocks": _WeightedBlocks}


def certain_depth(view: DepthView, max_relative_deviation: float, max_depth: float) -> Array:
    """The view's depth (H, W) float32 without the pixels (0) that are too far, or whose deviation is above this share of their depth."""
    depth, weights = (np.ascontiguousarray(a, np.float32) for a in (view.depth, view.weights))
    out = np.empty_like(depth)
    _keep_certain(depth.ravel(), weights.ravel(), np.float32(max_relative_deviation), np.float32(max_depth), out.ravel())
    return out


@kernel
def _keep_certain(depth, weights, max_relative_deviation, max_depth, out):  # type: ignore[no-untyped-def]
    for n in range(depth.shape[0]):
        limit = max_relative_deviation * depth[n]
        out[n] = depth[n] if depth[n] < max_depth and weights[n] * (limit * limit) >= np.float32(1.0) else np.float32(0.0)


def empty_surface() -> Surface:
    """A surface of nothing."""
    return _surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))


def _surface(vertices: Any, triangles: Any, colors: Any) -> Surface:
    """Our type from Open3D's arrays: colours in 0–1, no normals yet."""
    vertices = np.array(vertices, np.float64)
    bytes_rgb = np.rint(255.0 * np.clip(np.asarray(colors, np.float64), 0.0, 1.0)).astype(np.uint8)
    return Surface(vertices, np.array(triangles, np.int32), np.zeros_like(vertices), bytes_rgb)


@cache
def check_backend(backend: str) -> None:
    """Fuses a small plane, once per process: Open3D 0.20's ScalableTSDFVolume allocates nothing and says nothing.

    Raises:
        DependencyError: the plane does not come back.
    """
    canvas = PinholeCamera(40.0, 40.0, 19.5, 19.5, 40, 40)
    depth, normals, color = np.ones((40, 40), np.float32), np.zeros((40, 40, 3), np.float32), np.full((40, 40, 3), 128, np.uint8)
    volume = BACKENDS[backend](0.04, 0.16, Limits(10.0, 10.0))
    volume.integrate(DepthView(0, np.eye(4), depth, normals, color, np.ones_like(depth)), canvas, 2.0)
    if not _is_plane_at_one(volume.extract_surface().vertices_world):
        import open3d as o3d

        raise DependencyError(f"Open3D {o3d.__version__} ({backend}) fuses nothing; install 0.19 (`pip install 'open3d<0.20'`)")


def _is_plane_at_one(points: Array) -> bool:
    return len(points) > 20 and float(np.abs(points[:, 2] - 1.0).max()) < 0.02
