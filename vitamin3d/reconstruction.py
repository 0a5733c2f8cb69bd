# SPDX-License-Identifier: Apache-2.0
"""The dense half of VITAMIN-E (Sec. 4.2): keyframes with landmark depths -> meshes in the image -> TSDF -> surface."""

from collections.abc import Callable, Iterable, Iterator, Mapping

from vitamin3d.config import Config
from vitamin3d.dense.depth_rendering import DepthRenderer
from vitamin3d.dense.stages import Chain, Checking, Densifying, Meshing
from vitamin3d.dense.volumes import Volumes
from vitamin3d.geometry.cameras import Camera
from vitamin3d.steps import Mesher, Stage, Volume
from vitamin3d.types import Array, DepthView, MapSnapshot, StepTimes, Surface


class Reconstruction:
    """Turns keyframes into a coarse and a fine surface: a chain of stages, and the volumes that their views go into.

    Args:
        camera: of the snapshots' frames.
        config: its dense groups are used.
        times: grows by the milliseconds of each step.
        keeps_views: fused views are kept, so that `fuse_again` can move them; where the settings and the volume allow it.
        num_keyframes: that will come, all of a finished map; 0: they come while the camera is tracked.
        mesher: another than Delaunay's triangulation with NLTGV.
        make_volume: of voxels of this side in map units, another than the settings name.
    """

    def __init__(
        self, camera: Camera, config: Config, times: StepTimes | None = None, keeps_views: bool = False, num_keyframes: int = 0,
        mesher: Mesher | None = None, make_volume: Callable[[float], Volume] | None = None,
    ) -> None:  # fmt: skip
        self.times = times if times is not None else StepTimes()
        self.renderer = DepthRenderer(camera, config.depth_rendering)
        steps = self.renderer, config, self.times
        densifying = [Densifying(camera, *steps, num_keyframes)] if config.densification.enabled else []
        checking = [Checking(self.canvas, config.consistency, self.times)] if config.consistency.enabled else []
        self.densifying: Stage[MapSnapshot, MapSnapshot] = Chain(*densifying)
        self.meshing: Stage[MapSnapshot, DepthView] = Chain(mesher or Meshing(camera, *steps), *checking)
        self.chain: Stage[MapSnapshot, DepthView] = Chain(self.densifying, self.meshing)
        self.volumes = Volumes(self.renderer.canvas, config, self.times, keeps_views, make_volume)

    @property
    def canvas(self) -> Camera:
        """The undistorted camera of the depth views."""
        return self.renderer.canvas

    def add_keyframe(self, snapshot: MapSnapshot) -> list[DepthView]:
        """Takes a keyframe, in the order of time, and fuses those that have all their neighbours by now; their views."""
        return self._fused(self.chain.push(snapshot))

    def finish(self) -> list[DepthView]:
        """Fuses the keyframes that waited for neighbours; their views."""
        return self._fused(self.chain.flush())

    def _fused(self, views: Iterator[DepthView]) -> list[DepthView]:
        done = []
        for view in views:
            self.volumes.fuse(view)
            done.append(view)
        return done

    def depth_views(self, snapshots: Iterable[MapSnapshot]) -> Iterator[DepthView]:
        """The views of a whole sequence of keyframes, not fused; those with too few landmarks have none."""
        for snapshot in snapshots:
            yield from self.chain.push(snapshot)
        yield from self.chain.flush()

    def fuse_again(self, poses: Mapping[int, Array]) -> int:
        """Moves the views in the volumes whose keyframe is elsewhere by now; how many. `poses`: T_cam_world by time stamp (ns)."""
        return self.volumes.fuse_again(poses)

    def surfaces(self) -> tuple[Surface, Surface]:
        """The coarse and the fine surface of all keyframes so far, those that still waited for neighbours included."""
        self.finish()
        self.volumes.fuse_waiting()
        return self.volumes.surfaces()
