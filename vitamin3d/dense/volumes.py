# SPDX-License-Identifier: Apache-2.0
"""The coarse and the fine volume of one map (Sec. 4.2): views go in, may be moved, and two surfaces come out."""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from vitamin3d.config import Config
from vitamin3d.dense.surface_extraction import clean
from vitamin3d.dense.tsdf_fusion import Limits, TsdfVolume, empty_surface
from vitamin3d.dense.view_store import Packed, ViewStore, packed
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.steps import Volume
from vitamin3d.types import Array, DepthView, StepTimes, Surface

NO_NORMALS = np.zeros((0, 0, 3), np.float32)
"""Fusion needs depth and colour; the normals of waiting views are not kept."""


class Volumes:
    """Fuses depth views at two resolutions, chosen by the depth of the scene where they are not given.

    Args:
        canvas: camera of the views.
        keeps_views: fused views are kept, so that `fuse_again` can move them; where the settings and the volume allow it.
        make_volume: of voxels of this side in map units, able to `remove` where views are kept; None: as the settings name it.
    """

    def __init__(
        self, canvas: Camera, config: Config, times: StepTimes, keeps_views: bool = False,
        make_volume: Callable[[float], Volume] | None = None,
    ) -> None:  # fmt: skip
        self.canvas, self.config, self.times = canvas, config, times
        self._make_volume = make_volume or self._tsdf_volume
        self.low: Volume | None = None
        self.high: Volume | None = None
        self.median_depths: list[float] = []
        """Of each view so far."""
        self._waiting: list[DepthView] = []
        keeps_views = keeps_views and config.refusion.enabled and config.fusion.backend == "blocks"
        self.store = ViewStore(int(1e6 * config.refusion.max_megabytes)) if keeps_views else None

    def fuse(self, view: DepthView) -> list[DepthView]:
        """Integrates a view into both volumes, as soon as the voxels can be chosen; the views that are in them since now."""
        depth = _median_depth(view)
        if np.isnan(depth):
            return []  # nothing is drawn in it
        self.median_depths.append(depth)
        self._waiting.append(dataclasses.replace(view, normals_cam=NO_NORMALS))
        fusion = self.config.fusion
        are_known = self.low is not None or (fusion.voxel_low is not None and fusion.voxel_high is not None)
        return self.fuse_waiting() if are_known or len(self._waiting) >= fusion.keyframes_for_depth else []

    def fuse_waiting(self) -> list[DepthView]:
        """Fuses the views that waited until enough of the scene was seen to choose the voxels by its depth."""
        views, self._waiting = self._waiting, []
        for view in views:
            self._fuse(view)
        return views

    def voxel_lengths(self) -> tuple[float, float]:
        """Sides of the coarse and the fine voxels in map units: as configured, or fractions of the scene's median depth."""
        fusion = self.config.fusion
        depth = float(np.nanmedian(self.median_depths[: fusion.keyframes_for_depth]))
        return fusion.voxel_low or depth / fusion.depth_per_voxel_low, fusion.voxel_high or depth / fusion.depth_per_voxel_high

    def _fuse(self, view: DepthView) -> None:
        if self.low is None or self.high is None:
            self.low, self.high = (self._make_volume(length) for length in self.voxel_lengths())
        max_depth = self.config.fusion.max_depth * float(np.nanmedian(self.median_depths))
        if self.store is not None:
            with self.times.timed("keeping_views"):
                kept = packed(view, max_depth)
                self.store.add(kept)
                view, max_depth = kept.view(), np.inf  # exactly what will be taken out again
        with self.times.timed("fusion_low"):
            self.low.integrate(view, self.canvas, max_depth)
        with self.times.timed("fusion_high"):
            self.high.integrate(view, self.canvas, max_depth)

    def _tsdf_volume(self, voxel_length: float) -> Volume:
        fusion = self.config.fusion
        limits = Limits(fusion.max_relative_deviation, fusion.max_deviation_voxels * voxel_length)
        return TsdfVolume(voxel_length, fusion.truncation_voxels * voxel_length, limits, fusion.backend)

    # --- views whose keyframe moved ----------------------------------------------------------------------------------

    def fuse_again(self, poses: Mapping[int, Array]) -> int:
        """Moves the views in the volumes whose keyframe is elsewhere by now; how many.

        Args:
            poses: T_cam_world (4, 4) by time stamp (ns); views without one go: the map has given up their keyframes.
        """
        self.fuse_waiting()
        if self.store is None or self.low is None or self.high is None:
            return 0
        least = self.config.refusion.min_motion_voxels * self.high.voxel_length
        moved = {k.timestamp_ns for k in self.store.headers() if k.timestamp_ns not in poses or self._motion(k, poses) > least}
        for view in self.store.views(moved):
            with self.times.timed("refusion"):
                for volume in (self.low, self.high):
                    volume.remove(view, self.canvas, np.inf)
                    if view.timestamp_ns in poses:
                        at_new_pose = dataclasses.replace(view, T_cam_world=poses[view.timestamp_ns])
                        volume.integrate(at_new_pose, self.canvas, np.inf)
        self.store.close()
        return len(moved)

    def _motion(self, kept: Packed, poses: Mapping[int, Array]) -> float:
        """The farthest, in map units, that a corner of the picture at the view's middle depth moved in the world."""
        right, bottom = self.canvas.width - 1.0, self.canvas.height - 1.0
        corners = self.canvas.rays_from_ideal(np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])) * kept.middle_depth
        here, there = (inverse(T) for T in (kept.T_cam_world, poses[kept.timestamp_ns]))
        motions = corners @ (there - here)[:3, :3].T + (there - here)[:3, 3]
        return float(np.linalg.norm(motions, axis=1).max())

    # --- surfaces ----------------------------------------------------------------------------------------------------

    def surfaces(self) -> tuple[Surface, Surface]:
        """The coarse and the fine surface of the views that are fused; empty while the voxels are not chosen yet."""
        with self.times.timed("surface_low"):
            low = self._surface(self.low)
        with self.times.timed("surface_high"):
            high = self._surface(self.high)
        return low, high

    def _surface(self, volume: Volume | None) -> Surface:
        if volume is None or self.high is None:
            return empty_surface()
        coarser = volume.voxel_length / self.high.voxel_length
        least = round(self.config.surface.min_component_triangles / coarser**2)
        return clean(volume.extract_surface(), dataclasses.replace(self.config.surface, min_component_triangles=least))

    @property
    def filter_remark(self) -> str:
        """What is not in the surfaces, for the comments of their files."""
        fusion, pieces = self.config.fusion, f"pieces of fewer than {self.config.surface.min_component_triangles} fine triangles removed"
        return pieces if fusion.backend == "blocks" else f"depths of a relative deviation up to {fusion.max_relative_deviation:g}; {pieces}"


def _median_depth(view: DepthView) -> float:
    """Of every fourth pixel in both directions; NaN where none of them has one."""
    depths = view.depth[::4, ::4]
    return float(np.median(depths[depths > 0])) if (depths > 0).any() else np.nan
