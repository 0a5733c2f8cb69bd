# SPDX-License-Identifier: Apache-2.0
"""Depth views -> a truncated signed distance field -> a mesh (Sec. 4.2, "Mesh Integration in TSDF"; Curless and Levoy 1996)."""

from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.dense.block_volume import BlockVolume
from vitamin3d.dense.fused_views import FusedViews
from vitamin3d.dense.voxel_cloud import surface_of
from vitamin3d.errors import DependencyError, InputError
from vitamin3d.geometry.camera import Camera
from vitamin3d.types import Array, DepthView, Surface

BLOCK_RESOLUTION = 16
"""Voxels along the side of a block; all backends allocate by blocks."""
ALLOCATION_STRIDE = 8
"""Open3D's volume allocates for every so many-th pixel in both directions; a fine block is some hundred of them wide."""


@dataclass(frozen=True)
class Limits:
    """What is too uncertain to be fused."""

    relative_deviation: float
    """Of a pixel's depth over the depth; beyond it Open3D's volumes, which know no weights, do not get the pixel."""
    surface_deviation: float
    """Map units; the surface of `blocks` ends where all views together know it worse than this."""


class TsdfVolume:
    """A volume that depth views are averaged into; coarse and fine are two instances.

    Args:
        voxel_length: map units.
        truncation: map units; distances are kept up to this far from a surface.
        limits: what is too uncertain to be fused.
        backend: `scalable` (Open3D's ScalableTSDFVolume), `voxel_block_grid` (its tensor twin) or `blocks` (ours; every pixel
            has its weight, in the others all weigh the same).
        views: for `scalable`: what is integrated is kept there too, by the caller. The surface is then had from both, in less
            time, and the volume has no colours of its own.

    Raises:
        InputError: no such backend.
        DependencyError: the installed Open3D fuses nothing.
    """

    def __init__(
        self, voxel_length: float, truncation: float, limits: Limits, backend: str = "scalable", views: FusedViews | None = None
    ) -> None:
        if backend not in BACKENDS:
            raise InputError(f"fusion.backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
        check_backend(backend)
        self.voxel_length = voxel_length
        sides = (voxel_length, truncation, limits)
        self._volume: _Backend = BACKENDS[backend](*sides) if views is None else _ScalableVolume(*sides, views)

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        """Averages a view, drawn on `canvas`, into the volume; depths beyond `max_depth` (map units) are left out."""
        if ((view.depth > 0) & (view.depth < max_depth)).any():
            self._volume.integrate(view, canvas, max_depth)

    @property
    def can_remove(self) -> bool:
        """Whether views can be taken out again: of `blocks` alone."""
        return isinstance(self._volume, _WeightedBlocks)

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


class _Backend(Protocol):
    def __init__(self, voxel_length: float, truncation: float, limits: Limits) -> None: ...

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None: ...

    def extract_surface(self) -> Surface: ...

    def size(self) -> dict[str, int] | None: ...


class _ScalableVolume:
    """Open3D's ScalableTSDFVolume; with views that are kept beside it its surface and the colours come from them too."""

    def __init__(self, voxel_length: float, truncation: float, limits: Limits, views: FusedViews | None = None) -> None:
        import open3d as o3d

        self._voxel_length, self._truncation, self._limits, self._views = voxel_length, truncation, limits, views
        colors = o3d.pipelines.integration.TSDFVolumeColorType
        self._volume = o3d.pipelines.integration.ScalableTSDFVolume(
            voxel_length=voxel_length,
            sdf_trunc=truncation,
            color_type=colors.RGB8 if views is None else colors.NoColor,
            volume_unit_resolution=BLOCK_RESOLUTION,
            depth_sampling_stride=ALLOCATION_STRIDE,
        )

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        import open3d as o3d

        rgbd = o3d.geometry.RGBDImage()
        if self._views is None:
            rgbd.color = o3d.geometry.Image(np.ascontiguousarray(view.color))
        rgbd.depth = o3d.geometry.Image(certain_depth(view, self._limits.relative_deviation, max_depth))
        pinhole = o3d.camera.PinholeCameraIntrinsic(canvas.width, canvas.height, canvas.fx, canvas.fy, canvas.cx, canvas.cy)
        self._volume.integrate(rgbd, pinhole, view.T_cam_world)

    def size(self) -> dict[str, int] | None:
        return None

    def extract_surface(self) -> Surface:
        if self._views is not None:
            return surface_of(self._volume, self._voxel_length, self._truncation, self._views)
        mesh = self._volume.extract_triangle_mesh()
        return _surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles), np.asarray(mesh.vertex_colors))


class _VoxelBlockGrid:
    """Open3D's tensor VoxelBlockGrid on the CPU (its `ray_cast` crashes at random and is never called)."""

    def __init__(self, voxel_length: float, truncation: float, limits: Limits) -> None:
        import open3d as o3d

        self._truncation_voxels, self._limits = truncation / voxel_length, limits
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(o3d.core.float32, o3d.core.float32, o3d.core.float32),
            attr_channels=((1), (1), (3)),
            voxel_size=voxel_length,
            block_resolution=BLOCK_RESOLUTION,
            block_count=4000,
            device=o3d.core.Device("CPU:0"),
        )

    def integrate(self, view: DepthView, canvas: Camera, max_depth: float) -> None:
        import open3d as o3d

        depth = o3d.t.geometry.Image(o3d.core.Tensor(certain_depth(view, self._limits.relative_deviation, max_depth)))
        color = o3d.t.geometry.Image(o3d.core.Tensor(view.color.astype(np.float32) / 255.0))
        K, T = o3d.core.Tensor(canvas.K), o3d.core.Tensor(np.ascontiguousarray(view.T_cam_world, np.float64))
        scales = (1.0, max_depth, self._truncation_voxels)
        blocks = self._grid.compute_unique_block_coordinates(depth, K, T, *scales)
        self._grid.integrate(blocks, depth, color, K, K, T, *scales)

    def size(self) -> dict[str, int] | None:
        blocks, bytes_per_voxel = int(self._grid.hashmap().size()), 4 * (1 + 1 + 3)
        return {"blocks": blocks, "bytes": bytes_per_voxel * BLOCK_RESOLUTION**3 * int(self._grid.hashmap().capacity())}

    def extract_surface(self) -> Surface:
        if self._grid.hashmap().size() == 0:
            return empty_surface()
        mesh = self._grid.extract_triangle_mesh(weight_threshold=0.5)
        if "positions" not in mesh.vertex or not len(mesh.vertex.positions):
            return empty_surface()
        return _surface(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), mesh.vertex.colors.numpy())


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


BACKENDS: dict[str, type[_Backend]] = {"scalable": _ScalableVolume, "voxel_block_grid": _VoxelBlockGrid, "blocks": _WeightedBlocks}


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
    canvas = Camera(40.0, 40.0, 19.5, 19.5, 40, 40)
    depth, normals, color = np.ones((40, 40), np.float32), np.zeros((40, 40, 3), np.float32), np.full((40, 40, 3), 128, np.uint8)
    volume = BACKENDS[backend](0.04, 0.16, Limits(10.0, 10.0))
    volume.integrate(DepthView(0, np.eye(4), depth, normals, color, np.ones_like(depth)), canvas, 2.0)
    if not _is_plane_at_one(volume.extract_surface().vertices_world):
        import open3d as o3d

        raise DependencyError(f"Open3D {o3d.__version__} ({backend}) fuses nothing; install 0.19 (`pip install 'open3d<0.20'`)")


def _is_plane_at_one(points: Array) -> bool:
    return len(points) > 20 and float(np.abs(points[:, 2] - 1.0).max()) < 0.02
