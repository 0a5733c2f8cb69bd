# SPDX-License-Identifier: Apache-2.0
"""Which keyframes become depth views."""

import numpy as np

from vitamin3d.config import DensificationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse, transform_points
from vitamin3d.types import Array, MapSnapshot


def view_stride(num_keyframes: int, config: DensificationConfig) -> int:
    """Of how many keyframes one becomes a view: a short recording's are dearer than those of a long one, where many see each place.

    Args:
        num_keyframes: of the finished map; 0 where they come while the camera is tracked.
    """
    return max(config.keyframe_stride, min(config.max_stride, num_keyframes // config.max_views))


class ViewSelection:
    """Chooses every so many-th keyframe, and one in between where the picture has moved far since the last chosen one.

    Args:
        camera: of the snapshots' ideal pixels.
        stride: so many-th.
        far_px: so far, the median of the last view's landmarks.
    """

    def __init__(self, camera: Camera, stride: int, far_px: float) -> None:
        self.camera, self.stride, self.far_px = camera, stride, far_px
        self._since_last = stride - 1
        self._points_world, self._pixels = np.zeros((0, 3)), np.zeros((0, 2))

    def is_view(self, snapshot: MapSnapshot) -> bool:
        """Whether this keyframe, the next one in the order of time, becomes a view."""
        self._since_last += 1
        if self._since_last < self.stride and self._median_motion(snapshot.T_cam_world) < self.far_px:
            return False
        self._since_last = 0
        points = self.camera.rays_from_ideal(snapshot.pixels) * snapshot.depths[:, None]
        self._points_world, self._pixels = transform_points(inverse(snapshot.T_cam_world), points), snapshot.pixels
        return True

    def _median_motion(self, T_cam_world: Array) -> float:
        """By how many pixels half of the last view's landmarks have moved at least; infinite where half of them are behind the camera."""
        if not len(self._pixels):
            return np.inf
        moved = self.camera.ideal_from_points(transform_points(T_cam_world, self._points_world))
        return float(np.median(np.nan_to_num(np.linalg.norm(moved - self._pixels, axis=1), nan=np.inf)))
