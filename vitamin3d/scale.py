# SPDX-License-Identifier: Apache-2.0
"""The scale of a monocular map: unknown, given, or taken from a ground truth."""

from dataclasses import dataclass

import numpy as np

from vitamin3d.errors import InputError
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.types import Array, PointCloud, Surface, Trajectory

MATCH_TOLERANCE_NS = 20_000_000


@dataclass(frozen=True)
class Scale:
    """Metres per map unit; 1 and "up to scale" where nobody knows."""

    metres_per_unit: float = 1.0
    source: str = ""
    """`given`, `ground truth`, or empty: unknown."""

    @property
    def is_known(self) -> bool:
        return bool(self.source)

    @property
    def unit(self) -> str:
        return "metre" if self.is_known else "map unit"

    @property
    def remark(self) -> str:
        """For the comments of every file."""
        if not self.is_known:
            return "up to scale: lengths are in map units, the median depth at initialisation is about 1"
        return f"lengths in metres ({self.metres_per_unit:.9g} metres per map unit, {self.source})"

    def units(self, metres: float | None) -> float | None:
        """A length in metres as map units."""
        return None if metres is None else metres / self.metres_per_unit

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        poses = np.array(trajectory.T_world_cam)
        poses[:, :3, 3] *= self.metres_per_unit
        return Trajectory(trajectory.timestamps_ns, poses)

    def surface(self, surface: Surface) -> Surface:
        return Surface(surface.vertices_world * self.metres_per_unit, surface.triangles, surface.normals_world, surface.colors)

    def cloud(self, cloud: PointCloud) -> PointCloud:
        quality = (cloud.num_observations, cloud.parallax_deg, cloud.reprojection_rms_px, cloud.depth_deviation)
        return PointCloud(cloud.points_world * self.metres_per_unit, cloud.colors, *quality)


def match_timestamps(a_ns: Array, b_ns: Array, tolerance_ns: int = MATCH_TOLERANCE_NS) -> tuple[Array, Array]:
    """Rows of a (ascending) and of b (ascending) whose times agree: for each of a the nearest of b, within the tolerance."""
    if len(a_ns) == 0 or len(b_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    after = np.clip(np.searchsorted(b_ns, a_ns), 1, max(1, len(b_ns) - 1))
    after = np.minimum(after, len(b_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(a_ns - b_ns[before]) <= np.abs(b_ns[after] - a_ns), before, after)
    close = np.abs(b_ns[nearest] - a_ns) <= tolerance_ns
    return np.flatnonzero(close), nearest[close]


def scale_from_ground_truth(estimate: Trajectory, truth: Trajectory | None) -> Scale:
    """The scale that aligns the trajectory to the ground truth (least-squares similarity of the camera centres).

    Raises:
        InputError: there is no ground truth, or fewer than ten poses match in time.
    """
    if truth is None:
        raise InputError("--scale-from-ground-truth: the source has no ground truth; use --metric-scale or leave the option out")
    i, j = match_timestamps(estimate.timestamps_ns, truth.timestamps_ns)
    if len(i) < 10:
        raise InputError(f"--scale-from-ground-truth: only {len(i)} poses match the ground truth in time (20 ms); use --metric-scale")
    s, _, _ = align_sim3(estimate.T_world_cam[i, :3, 3], truth.T_world_cam[j, :3, 3])
    return Scale(s, "ground truth")
