# SPDX-License-Identifier: Apache-2.0
"""The dense half of VITAMIN-E (Sec. 4.2): keyframes with landmark depths -> meshes in the image -> TSDF -> surface."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from vitamin3d.config import Config
from vitamin3d.dense.consistency import voted
from vitamin3d.dense.delaunay import triangulate
from vitamin3d.dense.densification import CanvasPicture, Densifier
from vitamin3d.dense.depth_rendering import DepthRenderer
from vitamin3d.dense.extrapolation import extended, outline
from vitamin3d.dense.fused_views import FusedViews
from vitamin3d.dense.neighbour_queue import Around, NeighbourQueue
from vitamin3d.dense.nltgv import denoise
from vitamin3d.dense.photometric_check import marked, photometrically_checked
from vitamin3d.dense.surface_extraction import clean
from vitamin3d.dense.tsdf_fusion import Limits, TsdfVolume, certain_depth, empty_surface
from vitamin3d.dense.view_selection import ViewSelection, view_stride
from vitamin3d.dense.view_store import Packed, ViewStore, packed
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array, DepthView, MapSnapshot, StepTimes, Surface

NO_NORMALS = np.zeros((0, 0, 3), np.float32)
"""Fusion needs depth and colour; the normals of waiting views are not kept."""


def _is_older(timestamp_ns: int, now_ns: int, seconds: float) -> bool:
    """Whether something is older than so many seconds; never with 0."""
    return seconds > 0 and now_ns - timestamp_ns > 1e9 * seconds


def _median_depth(view: DepthView) -> float:
    """Of every fourth pixel in both directions; NaN where none of them has one."""
    depths = view.depth[::4, ::4]
    return float(np.median(depths[depths > 0])) if (depths > 0).any() else np.nan


class Reconstruction:
    """Turns keyframes into a coarse and a fine surface.

    Args:
        camera: of the snapshots' frames.
        config: its dense groups are used.
        times: grows by the milliseconds of each step.
        keeps_views: fused views are kept, so that `fuse_again` can move them; where the settings and the volume allow it.
        num_keyframes: that will come, all of a finished map; 0: they come while the camera is tracked.
    """

    def __init__(
        self, camera: Camera, config: Config, times: StepTimes | None = None, keeps_views: bool = False, num_keyframes: int = 0
    ) -> None:
        self.config = config
        self.times = times if times is not None else StepTimes()
        self.renderer = DepthRenderer(camera, config.depth_rendering)
        self._border = outline(camera, config.extrapolation.spacing_px)
        densification = config.densification
        self._densifier = Densifier(camera, self.renderer.canvas, densification)
        selection = ViewSelection(camera, view_stride(num_keyframes, densification), densification.view_motion_px)
        self._keyframes: NeighbourQueue[CanvasPicture] = NeighbourQueue(densification.reach, lambda p: selection.is_view(p.snapshot))
        self._drawn: NeighbourQueue[DepthView] = NeighbourQueue(config.consistency.reach if self._is_checked else 0)
        self.median_depths: list[float] = []
        self._waiting: list[DepthView] = []
        self.low: TsdfVolume | None = None
        self.high: TsdfVolume | None = None
        fusion = config.fusion
        self._fused_views = FusedViews(self.canvas, 1e6 * fusion.kept_megabytes) if fusion.backend == "scalable" else None
        keeps_views = keeps_views and config.refusion.enabled and fusion.backend == "blocks"
        self.store = ViewStore(int(1e6 * config.refusion.max_megabytes)) if keeps_views else None

    @property
    def canvas(self) -> Camera:
        """The undistorted camera of the depth views."""
        return self.renderer.canvas

    def add_keyframe(self, snapshot: MapSnapshot) -> list[DepthView]:
        """Takes a keyframe, in the order of time, and fuses those that have all their neighbours by now; their views."""
        return self._fused(self.depth_views_ready(snapshot))

    def finish(self) -> list[DepthView]:
        """Fuses the keyframes that waited for neighbours; their views."""
        return self._fused(self.last_depth_views())

    def depth_views(self, snapshots: Iterable[MapSnapshot]) -> Iterator[DepthView]:
        """The views of a whole sequence of keyframes, not fused yet; those with too few landmarks have none."""
        for snapshot in snapshots:
            yield from self.depth_views_ready(snapshot)
        yield from self.last_depth_views()

    def depth_views_ready(self, snapshot: MapSnapshot) -> Iterator[DepthView]:
        """Takes a keyframe, in the order of time; the views that have all their neighbours by now, not fused yet."""
        for denser in self.densified_ready(snapshot):
            yield from self.drawn_ready(denser)

    def last_depth_views(self) -> Iterator[DepthView]:
        """The views of keyframes that waited for neighbours, not fused yet: none will follow."""
        for denser in self.last_densified():
            yield from self.drawn_ready(denser)
        yield from self.last_drawn()

    def densified_ready(self, snapshot: MapSnapshot) -> Iterator[MapSnapshot]:
        """Takes a keyframe, in the order of time; with more vertices those that have all their neighbours by now."""
        yield from map(self._densified, self._ready(snapshot))
        yield from self.late_densified(snapshot.frame.timestamp_ns)

    def late_densified(self, now_ns: int) -> Iterator[MapSnapshot]:
        """With more vertices those that have waited too long for their neighbours, at this time of the recording."""
        wait_s = self.config.densification.max_wait_s
        yield from map(self._densified, self._keyframes.expire(lambda p: _is_older(p.snapshot.frame.timestamp_ns, now_ns, wait_s)))

    def last_densified(self) -> Iterator[MapSnapshot]:
        """Those that waited for neighbours: none will follow."""
        yield from map(self._densified, self._keyframes.flush())

    def drawn_ready(self, snapshot: MapSnapshot) -> Iterator[DepthView]:
        """Meshes, denoises and draws a keyframe; each view comes out when those around it are there to confirm it."""
        view = self.depth_view(snapshot)
        if view is not None:
            yield from map(self._checked, self._drawn.push(view))
        yield from self.late_drawn(snapshot.frame.timestamp_ns)

    def late_drawn(self, now_ns: int) -> Iterator[DepthView]:
        """The views that have waited too long for those around them, at this time of the recording."""
        wait_s = self.config.consistency.max_wait_s
        yield from map(self._checked, self._drawn.expire(lambda view: _is_older(view.timestamp_ns, now_ns, wait_s)))

    def last_drawn(self) -> Iterator[DepthView]:
        """The views that waited for those around them: none will follow."""
        yield from map(self._checked, self._drawn.flush())

    def forget_waiting(self) -> None:
        """Keyframes that wait for neighbours will not be fused."""
        self._keyframes.clear()
        self._drawn.clear()

    def _fused(self, views: Iterator[DepthView]) -> list[DepthView]:
        done = []
        for view in views:
            self.fuse(view)
            done.append(view)
        return done

    def _ready(self, snapshot: MapSnapshot) -> list[Around[CanvasPicture]]:
        picture = CanvasPicture(snapshot, self.renderer.draw_gray, self.renderer.is_outside)
        return self._keyframes.push(picture) if self.config.densification.enabled else [Around(picture, [], [])]

    def _densified(self, around: Around[CanvasPicture]) -> MapSnapshot:
        if not self.config.densification.enabled:
            return around.item.snapshot
        with self.times.timed("densification"):
            return self._densifier.densify(around)

    def _checked(self, around: Around[DepthView]) -> DepthView:
        consistency, photometric, view = self.config.consistency, self.config.photometric, around.item
        voters = [side[k - 1] for side in (around.before, around.after) for k in consistency.offsets if k <= len(side)]
        if consistency.enabled:
            with self.times.timed("consistency"):
                view = voted(view, voters, self.canvas, consistency.tolerance, consistency.contradicted_weight)
        if photometric.enabled:
            with self.times.timed("photometric_check"):
                view = photometrically_checked(view, voters, self.canvas, self.renderer.is_outside, photometric)
        return view

    @property
    def _is_checked(self) -> bool:
        """Whether views wait for those around them."""
        return self.config.consistency.enabled or self.config.photometric.enabled

    def depth_view(self, snapshot: MapSnapshot) -> DepthView | None:
        """Meshes, denoises and renders a keyframe; None where it has too few landmarks."""
        with self.times.timed("meshing"):
            mesh = triangulate(snapshot, self.config.delaunay)
        if mesh is None:
            return None
        with self.times.timed("denoising"):
            denoised = denoise(mesh, self.config.nltgv)
        mesh, slopes = denoised.mesh, denoised.slopes
        if self.config.extrapolation.enabled:
            with self.times.timed("extrapolation"):
                mesh, slopes = extended(mesh, slopes, self._border, self.config.extrapolation)
        with self.times.timed("rendering"):
            view = self.renderer.render(snapshot, mesh, slopes)
        photometric = self.config.photometric
        return marked(view, mesh, self.renderer, photometric) if photometric.enabled else view

    def fuse(self, view: DepthView) -> list[DepthView]:
        """Integrates a view into both volumes, as soon as the voxels can be chosen; the views that are in them since now."""
        self.median_depths.append(_median_depth(view))
        self._waiting.append(dataclasses.replace(view, normals_cam=NO_NORMALS))
        is_due = self._voxels_are_known or len(self._waiting) >= self.config.fusion.keyframes_for_depth
        return self._fuse_waiting() if is_due else []

    def surfaces(self) -> tuple[Surface, Surface]:
        """The coarse and the fine surface of all keyframes so far, those that still waited for neighbours included."""
        self.finish()
        self._fuse_waiting()
        return self.surfaces_so_far()

    def surfaces_so_far(self) -> tuple[Surface, Surface]:
        """The coarse and the fine surface of the keyframes that are fused; empty while the voxels are not chosen yet."""
        with self.times.timed("surface_low"):
            low = self._surface(self.low)
        with self.times.timed("surface_high"):
            high = self._surface(self.high)
        return low, high

    @property
    def filter_remark(self) -> str:
        """What is not in the surfaces, for the comments of their files."""
        fusion, pieces = self.config.fusion, f"pieces of fewer than {self.config.surface.min_component_triangles} fine triangles removed"
        return pieces if fusion.backend == "blocks" else f"depths of a relative deviation up to {fusion.max_relative_deviation:g}; {pieces}"

    def voxel_lengths(self) -> tuple[float, float]:
        """Sides of the coarse and the fine voxels in map units: as configured, or fractions of the scene's median depth."""
        fusion = self.config.fusion
        depth = float(np.nanmedian(self.median_depths[: fusion.keyframes_for_depth]))
        return fusion.voxel_low or depth / fusion.depth_per_voxel_low, fusion.voxel_high or depth / fusion.depth_per_voxel_high

    @property
    def _voxels_are_known(self) -> bool:
        fusion = self.config.fusion
        return self.low is not None or (fusion.voxel_low is not None and fusion.voxel_high is not None)

    def _fuse_waiting(self) -> list[DepthView]:
        """Fuses the views that waited until enough of the scene was seen to choose the voxels by its depth."""
        views, self._waiting = self._waiting, []
        for view in views:
            self._fuse(view)
        return views

    def _fuse(self, view: DepthView) -> None:
        if self.low is None or self.high is None:
            self.low, self.high = (self._volume(length) for length in self.voxel_lengths())
        max_depth = self.config.fusion.max_depth * float(np.nanmedian(self.median_depths))
        if self.store is not None:
            with self.times.timed("keeping_views"):
                kept = packed(view, max_depth)
                self.store.add(kept)
                view, max_depth = kept.view(), np.inf  # exactly what will be taken out again
        if self._fused_views is not None:
            with self.times.timed("keeping_views"):
                self._fused_views.add(view, certain_depth(view, self.config.fusion.max_relative_deviation, max_depth))
        with self.times.timed("fusion_low"):
            self.low.integrate(view, self.canvas, max_depth)
        with self.times.timed("fusion_high"):
            self.high.integrate(view, self.canvas, max_depth)

    def fuse_again(self, poses: Mapping[int, Array]) -> int:
        """Moves the views in the volumes whose keyframe is elsewhere by now; how many.

        Args:
            poses: T_cam_world (4, 4) by time stamp (ns); views without one stay.
        """
        self._fuse_waiting()
        if self.store is None or self.low is None or self.high is None:
            return 0
        least = self.config.refusion.min_motion_voxels * self.high.voxel_length
        moved = {kept.timestamp_ns for kept in self.store.headers() if self._motion(kept, poses) > least}
        for view in self.store.views(moved):
            with self.times.timed("refusion"):
                at_new_pose = dataclasses.replace(view, T_cam_world=poses[view.timestamp_ns])
                for volume in (self.low, self.high):
                    volume.remove(view, self.canvas, np.inf)
                    volume.integrate(at_new_pose, self.canvas, np.inf)
        self.store.close()
        return len(moved)

    def _motion(self, kept: Packed, poses: Mapping[int, Array]) -> float:
        """The farthest, in map units, that a corner of the picture at the view's middle depth moved in the world."""
        if kept.timestamp_ns not in poses:
            return 0.0
        right, bottom = self.canvas.width - 1.0, self.canvas.height - 1.0
        corners = self.canvas.rays_from_ideal(np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])) * kept.middle_depth
        here, there = (inverse(T) for T in (kept.T_cam_world, poses[kept.timestamp_ns]))
        motions = corners @ (there - here)[:3, :3].T + (there - here)[:3, 3]
        return float(np.linalg.norm(motions, axis=1).max())

    def _volume(self, voxel_length: float) -> TsdfVolume:
        fusion = self.config.fusion
        limits = Limits(fusion.max_relative_deviation, fusion.max_deviation_voxels * voxel_length)
        return TsdfVolume(voxel_length, fusion.truncation_voxels * voxel_length, limits, fusion.backend, self._fused_views)

    def _surface(self, volume: TsdfVolume | None) -> Surface:
        if volume is None or self.high is None:
            return empty_surface()
        coarser = volume.voxel_length / self.high.voxel_length
        least = round(self.config.surface.min_component_triangles / coarser**2)
        return clean(volume.extract_surface(), replace(self.config.surface, min_component_triangles=least))
