# SPDX-License-Identifier: Apache-2.0
"""How long tracks live and how well they obey the epipolar geometry: no depth is needed, only poses.

The arrays are those of `tracks.npz`, one row per track and frame in which it was seen (not where it coasts): frame_index
(N,) int, track_id (N,) int, pixel (N, 2). Ages count recorded frames, so that a stride does not matter.
"""

from dataclasses import dataclass

import numpy as np

from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.epipolar_refinement import sampson_distances
from vitamin3d.geometry.se3 import inverse, skew
from vitamin3d.scale import match_timestamps
from vitamin3d.types import Array, Trajectory

AGES = (1, 5, 10, 20, 40)
INLIER_PX = 1.0
MIN_BASELINE = 1e-9
"""Camera centres nearer to each other, in the trajectory's unit, have no epipolar geometry."""


@dataclass(frozen=True)
class AgeStatistics:
    """What has become of tracks some frames later; NaN where no frame has one that much later."""

    age: int
    """Frames."""
    survival: float
    """Share of the tracks of a frame that are seen `age` frames later; those that left the picture count as lost."""
    epipolar_inlier_ratio: float
    """Share of these, between frames that have poses, with a Sampson distance below one pixel."""


@dataclass(frozen=True)
class TrackStatistics:
    """The tracks of a run in numbers."""

    live_median: float
    """Tracks seen per frame."""
    live_minimum: int
    length_median: float
    """Frames from a track's first to its last sight, both counted."""
    length_p90: float
    num_tracks: int
    ages: tuple[AgeStatistics, ...]


def track_statistics(frame_index: Array, track_id: Array, pixels: Array, T_world_cam: Array, camera: Camera) -> TrackStatistics:
    """All statistics of the tracks of a run.

    Args:
        frame_index, track_id, pixels: of `tracks.npz`, distorted pixels.
        T_world_cam: (F, 4, 4) poses of the recorded frames (`poses_at` of `np.unique(frame_index)`), NaN where unknown.
        camera: of the pictures.
    """
    live, lengths, ideal = live_tracks(frame_index), track_lengths(frame_index, track_id), camera.undistort(pixels)
    ages = tuple(
        AgeStatistics(age, survival(frame_index, pairs, age), epipolar_inlier_ratio(frame_index, ideal, pairs, T_world_cam, camera))
        for age in AGES
        for pairs in [pairs_at_age(frame_index, track_id, age)]
    )
    if len(live) == 0:
        return TrackStatistics(0.0, 0, 0.0, 0.0, 0, ages)
    median, p90 = np.percentile(lengths, [50, 90])
    return TrackStatistics(float(np.median(live)), int(live.min()), float(median), float(p90), len(lengths), ages)


def live_tracks(frame_index: Array) -> Array:
    """Tracks (F,) seen in each recorded frame."""
    return np.unique(frame_index, return_counts=True)[1]


def recorded_frames(frame_index: Array) -> Array:
    """Each row's frame (N,) as a position among the frames recorded."""
    return np.unique(frame_index, return_inverse=True)[1].reshape(-1)


def track_lengths(frame_index: Array, track_id: Array) -> Array:
    """Frames (T,) from the first to the last sight of each track, both counted."""
    frames = recorded_frames(frame_index)
    tracks = np.unique(track_id, return_inverse=True)[1].reshape(-1)
    first = np.full(int(tracks.max(initial=-1)) + 1, len(frames), np.int64)
    last = np.zeros_like(first)
    np.minimum.at(first, tracks, frames)
    np.maximum.at(last, tracks, frames)
    return last - first + 1


def pairs_at_age(frame_index: Array, track_id: Array, age: int) -> Array:
    """Rows (P, 2): a track in a frame, and the same track `age` recorded frames later."""
    frames = recorded_frames(frame_index)
    key = np.asarray(track_id, np.int64) * (int(frames.max(initial=0)) + age + 1) + frames
    _, later, first = np.intersect1d(key, key + age, assume_unique=True, return_indices=True)
    return np.stack([first, later], axis=1)


def survival(frame_index: Array, pairs: Array, age: int) -> float:
    """Of the rows of all frames that have one `age` frames later, the share that is seen then; NaN for none."""
    frames = recorded_frames(frame_index)
    due = int((frames + age <= frames.max(initial=0)).sum())
    return len(pairs) / due if due else float("nan")


def poses_at(times_ns: Array, trajectory: Trajectory, tolerance_ns: int) -> Array:
    """Poses (T, 4, 4) of a trajectory at the times (T,), ascending; NaN where it has none that near."""
    poses = np.full((len(times_ns), 4, 4), np.nan)
    i, j = match_timestamps(times_ns, trajectory.timestamps_ns, tolerance_ns)
    poses[i] = trajectory.T_world_cam[j]
    return poses


def epipolar_inlier_ratio(
    frame_index: Array, ideal_pixels: Array, pairs: Array, T_world_cam: Array, camera: Camera, threshold_px: float = INLIER_PX
) -> float:
    """Share of the pairs with a Sampson distance below the threshold; pairs without poses or baseline are left out.

    Args:
        frame_index: (N,) of the rows.
        ideal_pixels: (N, 2) of the rows.
        pairs: (P, 2) rows, from and to, all as many recorded frames apart.
        T_world_cam: (F, 4, 4) poses of the recorded frames, NaN where unknown.
        camera: of the pixels.
    """
    frames = recorded_frames(frame_index)
    pairs = pairs[np.argsort(frames[pairs[:, 0]], kind="stable")]
    starts = np.flatnonzero(np.diff(frames[pairs[:, 0]])) + 1
    distances = [np.zeros(0)]
    for group in np.split(pairs, starts) if len(pairs) else []:
        a, b = frames[group[0]]
        T_b_a = inverse(T_world_cam[b]) @ T_world_cam[a]
        distances.append(epipolar_distances(ideal_pixels[group[:, 0]], ideal_pixels[group[:, 1]], T_b_a, camera))
    found = np.concatenate(distances)
    found = found[np.isfinite(found)]
    return float((found < threshold_px).mean()) if len(found) else float("nan")


def epipolar_distances(ideal_0: Array, ideal_1: Array, T_1_0: Array, camera: Camera) -> Array:
    """First-order distances (N,) in pixels of pairs of ideal pixels (N, 2) from epipolar geometry; NaN without a baseline.

    Only the error across the epipolar line is seen: one along it looks like another depth.
    """
    if not np.linalg.norm(T_1_0[:3, 3]) > MIN_BASELINE:
        return np.full(len(ideal_0), np.nan)
    K_inverse = np.linalg.inv(camera.K)
    F = K_inverse.T @ skew(T_1_0[:3, 3] / np.linalg.norm(T_1_0[:3, 3])) @ T_1_0[:3, :3] @ K_inverse
    x_0, x_1 = (np.column_stack([pixels, np.ones(len(pixels))]) for pixels in (ideal_0, ideal_1))
    return np.abs(sampson_distances(F, x_0, x_1))
