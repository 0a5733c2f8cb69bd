# SPDX-License-Identifier: Apache-2.0
"""What the map knows about its landmarks: observations, parallax, reprojection error, deviation of the depth."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import CloudConfig, SnapshotConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.reprojection import linearize, squared_error
from vitamin3d.geometry.se3 import inverse
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, PointCloud

LEAST_DETERMINANT = 1e-15
"""Of an information over its trace cubed; below it the landmark is undetermined, as far as numbers can tell."""


@kernel
def _information(intrinsics, R, t, starts, obs_landmark, obs_valid, obs_pixels, first, points, wanted, H, squared, count):  # type: ignore[no-untyped-def]
    """Adds JᵀJ (3, 3) and |r|² of each counting observation of each wanted landmark, at its number in `wanted`."""
    r, J_pose, J = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    for k in range(R.shape[0]):
        for i in range(starts[k], starts[k + 1]):
            id_ = obs_landmark[i]
            at = wanted[id_]
            if at < 0 or not obs_valid[i] or i < first[id_]:
                continue
            if linearize(intrinsics, R[k], t[k], points[id_], obs_pixels[i], r, J_pose, J):
                squared[at] += r[0] * r[0] + r[1] * r[1]
                count[at] += 1
                for m in range(3):
                    for n in range(3):
                        H[at, m, n] += J[0, m] * J[0, n] + J[1, m] * J[1, n]


@kernel
def add_squared_errors(  # type: ignore[no-untyped-def]
    intrinsics, R, t, starts, oldest, obs_landmark, obs_valid, obs_pixels, first, points, wanted, squared, count
):
    """Adds squared errors and number of the observations, from the `oldest` keyframe on, of tracks at their numbers in `wanted`.

    `first` and `points` are by that number; -1: not wanted.
    """
    for k in range(oldest, R.shape[0]):
        for i in range(starts[k], starts[k + 1]):
            at = wanted[obs_landmark[i]]
            if at >= 0 and obs_valid[i] and i >= first[at]:
                squared[at] += squared_error(intrinsics, R[k], t[k], points[at], obs_pixels[i])
                count[at] += 1


@kernel
def _farthest_rays(centers, starts, obs_landmark, obs_valid, first, points, reference, low, farthest):  # type: ignore[no-untyped-def]
    """Per landmark: the ray at the largest angle to its `reference` ray (the first one where that is NaN), and the angle's cosine."""
    for k in range(centers.shape[0]):
        for i in range(starts[k], starts[k + 1]):
            id_ = obs_landmark[i]
            if not obs_valid[i] or i < first[id_] or np.isnan(points[id_, 0]):
                continue
            x, y, z = points[id_, 0] - centers[k, 0], points[id_, 1] - centers[k, 1], points[id_, 2] - centers[k, 2]
            norm = np.sqrt(x * x + y * y + z * z)
            x, y, z = x / norm, y / norm, z / norm
            if np.isnan(reference[id_, 0]):
                reference[id_, 0], reference[id_, 1], reference[id_, 2] = x, y, z
            cosine = x * reference[id_, 0] + y * reference[id_, 1] + z * reference[id_, 2]
            if cosine <= low[id_]:
                low[id_], farthest[id_, 0], farthest[id_, 1], farthest[id_, 2] = cosine, x, y, z


@kernel
def _deviate(information, points, poses, out):  # type: ignore[no-untyped-def]
    """sqrt(zᵀ C z) over the depth, z the camera's axis in the world and C the inverse of the information, by its cofactors."""
    for n in range(points.shape[0]):
        a, b, c = information[n, 0]
        d, e, f = information[n, 1, 1], information[n, 1, 2], information[n, 2, 2]
        aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
        det, trace = a * aa + b * bb + c * cc, a + d + f
        x, y, z = poses[n, 2, 0], poses[n, 2, 1], poses[n, 2, 2]
        depth = x * points[n, 0] + y * points[n, 1] + z * points[n, 2] + poses[n, 2, 3]
        along = x * x * aa + y * y * (a * f - c * c) + z * z * (a * d - b * b)
        across = x * y * bb + x * z * cc + y * z * (b * c - a * e)
        is_regular = det > LEAST_DETERMINANT * trace * trace * trace
        out[n] = np.sqrt(max((along + 2.0 * across) / det, 0.0)) / max(depth, 1e-12) if is_regular else np.inf


@dataclass(frozen=True)
class LandmarkStatistics:
    """By row; zeros for tracks that are no landmarks."""

    num_observations: Array
    """(L,) int32, in keyframes."""
    reprojection_rms_px: Array
    """(L,)."""
    parallax_deg: Array
    """(L,) the widest angle between two rays: between the one farthest from the first, and the one farthest from that."""


def landmark_statistics(sparse_map: SparseMap, camera: Camera) -> LandmarkStatistics:
    """Observations, reprojection error and parallax of all landmarks."""
    size, poses = len(sparse_map.points_world), sparse_map.T_cam_world
    count, squared = np.zeros(size, np.int32), np.zeros(size)
    starts, R, t = np.array(sparse_map.keyframe_starts), np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
    wanted = np.where(np.isnan(sparse_map.points_world[:, 0]), -1, np.arange(size))
    add_squared_errors(
        camera.intrinsics, R, t, starts, 0, sparse_map.obs_landmark, sparse_map.obs_valid, sparse_map.obs_pixels,
        sparse_map.first_observation, sparse_map.points_world, wanted, squared, count,
    )  # fmt: skip
    return LandmarkStatistics(count, np.sqrt(squared / np.maximum(count, 1)), _widest_angles(sparse_map))


def _widest_angles(sparse_map: SparseMap) -> Array:
    """(L,) degrees; see `LandmarkStatistics.parallax_deg`."""
    size, centers = len(sparse_map.points_world), np.ascontiguousarray(inverse(sparse_map.T_cam_world)[:, :3, 3])
    rays, starts = np.full((size, 3), np.nan), np.array(sparse_map.keyframe_starts)
    for _ in range(2):
        reference, rays, low = rays, np.full((size, 3), np.nan), np.ones(size)
        _farthest_rays(
            centers, starts, sparse_map.obs_landmark, sparse_map.obs_valid, sparse_map.first_observation, sparse_map.points_world,
            reference, low, rays,
        )  # fmt: skip
    return np.asarray(np.degrees(np.arccos(np.clip(low, -1.0, 1.0))))


def landmark_information(sparse_map: SparseMap, landmarks: Array, camera: Camera, config: SnapshotConfig) -> Array:
    """Inverse covariance (N, 3, 3) of landmarks (N,) rows, in the world."""
    information, squared, count = unit_information(sparse_map, landmarks, camera)
    return np.asarray(information / observation_variances(squared, count, config)[:, None, None])


def observation_variances(squared: Array, count: Array, config: SnapshotConfig) -> Array:
    """Variances (N,) in pixels² by which the inverse of a unit information becomes a covariance.

    The noise of a landmark's observations is what its residuals show; a part of it they share (the extremum's bias, the
    errors of neighbouring poses), which does not shrink with their number.

    Args:
        squared: (N,) sums of squared reprojection errors, pixels².
        count: (N,) observations.
    """
    noise = np.maximum(squared / np.maximum(2 * count - 3, 1), config.min_observation_sigma_px**2)
    return np.asarray(noise * (1.0 + config.shared_error * count))


class UnitInformation(NamedTuple):
    """What observations say about N landmarks, for a pixel of noise."""

    information: Array
    """(N, 3, 3) sums of JᵀJ, in the world."""
    squared: Array
    """(N,) sums of squared reprojection errors, pixels²."""
    counts: Array
    """(N,) observations."""

    def of(self, chosen: Array) -> "UnitInformation":
        """That of some landmarks, by their numbers (M,) among these."""
        return UnitInformation(self.information[chosen], self.squared[chosen], self.counts[chosen])


def unit_information(sparse_map: SparseMap, landmarks: Array, camera: Camera) -> UnitInformation:
    """What the observations in keyframes say about landmarks (N,) rows; one pass over all observations of the map."""
    wanted = np.full(len(sparse_map.points_world), -1, np.int64)
    wanted[landmarks] = np.arange(len(landmarks))
    poses, n = sparse_map.T_cam_world, len(landmarks)
    H, squared, count = np.zeros((n, 3, 3)), np.zeros(n), np.zeros(n, np.int64)
    R, t = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
    _information(
        camera.intrinsics, R, t, np.array(sparse_map.keyframe_starts), sparse_map.obs_landmark, sparse_map.obs_valid,
        sparse_map.obs_pixels, sparse_map.first_observation, sparse_map.points_world, wanted, H,
        squared, count,
    )  # fmt: skip
    return UnitInformation(H, squared, count)


def information_by_row(sparse_map: SparseMap, camera: Camera) -> UnitInformation:
    """That of all landmarks, by row (L,): for a map that changes no more, so that each keyframe need not look for its own."""
    return unit_information(sparse_map, np.arange(len(sparse_map.points_world)), camera)


def relative_depth_deviations(information: Array, points_world: Array, T_cam_world: Array) -> Array:
    """Standard deviation of the depth z over the depth, (N,), seen from a camera; inf where it is undetermined.

    Args:
        information: (N, 3, 3) inverse covariances in the world.
        points_world: (N, 3).
        T_cam_world: (4, 4) or (N, 4, 4).
    """
    out, poses = np.empty(len(points_world)), np.broadcast_to(T_cam_world, (len(points_world), 4, 4))
    _deviate(np.ascontiguousarray(information), np.ascontiguousarray(points_world), poses, out)
    return out


class Vertices(NamedTuple):
    """Landmarks as a keyframe sees them."""

    pixels: Array
    """(N, 2) ideal pixels of their projections."""
    depths: Array
    """(N,)."""
    relative_deviations: Array
    """(N,)."""


def keyframe_vertices(
    sparse_map: SparseMap, keyframe: int, camera: Camera, config: SnapshotConfig, by_row: UnitInformation | None = None
) -> Vertices:
    """The landmarks observed in a keyframe; `by_row` as for `vertices_of`."""
    rows = sparse_map.observations_of(keyframe)
    landmarks = sparse_map.obs_landmark[rows]
    return vertices_of(
        sparse_map, landmarks[sparse_map.obs_valid[rows] & sparse_map.is_mapped(landmarks)], keyframe, camera, config, by_row
    )


def vertices_of(
    sparse_map: SparseMap, landmarks: Array, keyframe: int, camera: Camera, config: SnapshotConfig, by_row: UnitInformation | None = None
) -> Vertices:
    """Of landmarks (N,) rows, those in front of a keyframe's camera whose depth is known well enough.

    Args:
        by_row: `information_by_row` of the map as it is, where there is one.
    """
    landmarks = landmarks[sparse_map.num_observations[landmarks] >= config.min_observations]
    points, T = sparse_map.points_world[landmarks], sparse_map.T_cam_world[keyframe]
    in_camera = points @ T[:3, :3].T + T[:3, 3]
    information, squared, count = unit_information(sparse_map, landmarks, camera) if by_row is None else by_row.of(landmarks)
    variances, rms = observation_variances(squared, count, config), np.sqrt(squared / np.maximum(count, 1))
    deviations = relative_depth_deviations(information / variances[:, None, None], points, T)
    usable = (in_camera[:, 2] > 0) & (deviations < config.max_relative_deviation) & (rms < config.max_reprojection_rms_px)
    return Vertices(camera.ideal_from_points(in_camera[usable]), in_camera[usable, 2], deviations[usable])


def point_cloud(sparse_map: SparseMap, camera: Camera, config: CloudConfig, noise: SnapshotConfig) -> PointCloud:
    """The landmarks that pass the export's filter, with what is known about them."""
    statistics = landmark_statistics(sparse_map, camera)
    good = ~np.isnan(sparse_map.points_world[:, 0]) & (statistics.num_observations >= config.min_observations)
    good &= (statistics.parallax_deg >= config.min_parallax_deg) & (statistics.reprojection_rms_px <= config.max_reprojection_rms_px)
    landmarks = np.flatnonzero(good)
    points = sparse_map.points_world[landmarks]
    information = landmark_information(sparse_map, landmarks, camera, noise)
    last_seen_from = sparse_map.T_cam_world[sparse_map.keyframe_of(sparse_map.last_observation[landmarks])]
    return PointCloud(
        points,
        sparse_map.colors[landmarks],
        statistics.num_observations[landmarks],
        statistics.parallax_deg[landmarks].astype(np.float32),
        statistics.reprojection_rms_px[landmarks].astype(np.float32),
        relative_depth_deviations(information, points, last_seen_from).astype(np.float32),
    )
