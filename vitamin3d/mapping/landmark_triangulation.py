# SPDX-License-Identifier: Apache-2.0
"""New landmarks from tracks that have gained enough parallax (Sec. 5.1)."""

from dataclasses import dataclass

import numpy as np

from vitamin3d.config import TriangulationConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.geometry.triangulation import triangulate
from vitamin3d.mapping.landmark_statistics import add_squared_errors
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array


@dataclass
class Rigidity:
    """Of the tracks of a map that showed parallax, how many did so as points of one rigid scene."""

    num_tracks: int = 0
    num_rigid: int = 0

    def add(self, num_tracks: int, num_rigid: int) -> None:
        """Counts tracks with parallax, and those among them that have become landmarks."""
        self.num_tracks += num_tracks
        self.num_rigid += num_rigid

    @property
    def share(self) -> float:
        """In [0, 1]; 1 where no track has shown parallax yet."""
        return self.num_rigid / self.num_tracks if self.num_tracks else 1.0


def triangulate_landmarks(sparse_map: SparseMap, camera: Camera, config: TriangulationConfig, rigidity: Rigidity | None = None) -> int:
    """Gives points to the newest keyframe's tracks that have none, from their first and their newest observation.

    A point must have the parallax, more where the cameras' places are less certain; lie in front of both cameras; reproject well in both.

    Args:
        rigidity: counts the tracks with parallax and those that became landmarks.

    Returns:
        The number of new landmarks.
    """
    newest = sparse_map.num_keyframes - 1
    rows = np.arange(*sparse_map.observations_of(newest).indices(len(sparse_map.obs_landmark)))
    ids = sparse_map.obs_landmark[rows]
    first = sparse_map.first_observation[ids]
    pending = ~sparse_map.is_mapped(ids) & (first >= 0) & (first < rows[0]) & sparse_map.obs_valid[rows]
    pending[pending] &= sparse_map.num_observations[ids[pending]] >= config.min_observations
    rows, ids, first = rows[pending], ids[pending], first[pending]
    points, has_parallax, good = _two_ray_points(sparse_map, first, rows, camera, config)
    rows, ids, first, points = rows[good], ids[good], first[good], points[good]
    good = _agrees_between(sparse_map, ids, first, points, camera, config)
    sparse_map.points_world[ids[good]] = points[good]
    if rigidity is not None:
        rigidity.add(int(has_parallax.sum()), int(good.sum()))
    return int(good.sum())


def _agrees_between(sparse_map: SparseMap, ids: Array, first: Array, points: Array, camera: Camera, config: TriangulationConfig) -> Array:
    """(N,) bool: points whose observations between the first and the newest agree with them too: what slides or steps does not."""
    if len(ids) == 0 or config.max_rms_px == 0.0:
        return np.ones(len(ids), np.bool_)
    wanted = np.full(len(sparse_map.points_world), -1, np.int64)
    wanted[ids] = np.arange(len(ids))
    squared, count, poses = np.zeros(len(ids)), np.zeros(len(ids), np.int64), sparse_map.T_cam_world
    oldest = max(int(sparse_map.keyframe_of(first).min()), sparse_map.num_keyframes - config.checked_keyframes)
    R, t = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
    add_squared_errors(
        camera.intrinsics, R, t, np.array(sparse_map.keyframe_starts), oldest, sparse_map.obs_landmark, sparse_map.obs_valid,
        sparse_map.obs_pixels, first, points, wanted, squared, count,
    )  # fmt: skip
    return np.asarray(np.sqrt(squared / np.maximum(count, 1)) <= config.max_rms_px)


def _least_parallax_deg(sparse_map: SparseMap, first: Array, config: TriangulationConfig) -> Array:
    """(N,) that the scene must show between the keyframes of observations `first` (N,) and the newest, above that of the poses' errors."""
    deviations = sparse_map.position_deviations_deg
    of_pair = np.hypot(deviations[sparse_map.keyframe_of(first)], deviations[-1])
    return np.asarray(np.maximum(config.min_parallax_deg, config.parallax_deviations * of_pair))


def _two_ray_points(
    sparse_map: SparseMap, first: Array, newest: Array, camera: Camera, config: TriangulationConfig
) -> tuple[Array, Array, Array]:
    """World points (N, 3) of two observations each, which of them (N,) have parallax, and which pass the other gates as well."""
    T_a_world = sparse_map.T_cam_world[sparse_map.keyframe_of(first)]
    T_b_world = sparse_map.T_cam_world[-1]
    pixels_a, pixels_b = sparse_map.obs_pixels[first], sparse_map.obs_pixels[newest]
    T_world_a = inverse(T_a_world)
    points_a, parallax = triangulate(camera.rays_from_ideal(pixels_a), camera.rays_from_ideal(pixels_b), T_b_world @ T_world_a)
    points = np.einsum("nij,nj->ni", T_world_a[:, :3, :3], points_a) + T_world_a[:, :3, 3]
    points_b = points @ T_b_world[:3, :3].T + T_b_world[:3, 3]
    with np.errstate(invalid="ignore"):
        error_a = np.linalg.norm(camera.ideal_from_points(points_a) - pixels_a, axis=1)
        error_b = np.linalg.norm(camera.ideal_from_points(points_b) - pixels_b, axis=1)
        has_parallax = parallax >= _least_parallax_deg(sparse_map, first, config)
        good = has_parallax & (np.maximum(error_a, error_b) <= config.max_reprojection_px)
    return points, has_parallax, good
