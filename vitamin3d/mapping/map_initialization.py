# SPDX-License-Identifier: Apache-2.0
"""The first map: the two views' points, the keyframes between them, and an adjustment of it all (Sec. 5.1)."""

from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.schur import adjust_schur
from vitamin3d.bundle_adjustment.variables import squared_reprojection_errors
from vitamin3d.config import Config
from vitamin3d.geometry.camera import Camera
from vitamin3d.mapping.initialization_history import TrackedView, shared_tracks
from vitamin3d.mapping.landmark_recovery import cut_patches
from vitamin3d.mapping.landmark_triangulation import triangulate_landmarks
from vitamin3d.mapping.p3p_localization import localize
from vitamin3d.mapping.sparse_map import SparseMap
from vitamin3d.mapping.two_view_initialization import median_motion
from vitamin3d.mapping.window_selection import build_problem, store_solution, whole_map
from vitamin3d.types import Array, Frame, TwoView

ADJUSTMENT_ITERATIONS = 20
MAX_RMSE_PX = 2.0


@dataclass(frozen=True)
class FirstMap:
    """A map with its keyframes' views, the reference's camera being the world, the median depth there 1."""

    map: SparseMap
    keyframe_views: list[TrackedView]


def sample_colors(frame: Frame, pixels: Array) -> Array:
    """RGB (N, 3) uint8 of a frame at distorted pixels (N, 2), nearest."""
    at = np.rint(pixels).astype(np.int64)
    u, v = np.clip(at[:, 0], 0, frame.image.shape[1] - 1), np.clip(at[:, 1], 0, frame.image.shape[0] - 1)
    return frame.color[v, u] if frame.color is not None else np.repeat(frame.image[v, u, None], 3, axis=1)


def build_first_map(two_view: TwoView, ids: Array, views: list[TrackedView], camera: Camera, config: Config) -> FirstMap | None:
    """The map of the reference, the newest view and the keyframes between them; None where it does not hold together.

    Args:
        two_view: of views[0] and views[-1].
        ids: (N,) track ids of its points.
        views: from the reference to the newest.
    """
    good = np.isfinite(two_view.points_0[:, 0])
    scale = 1.0 / float(np.median(two_view.points_0[good, 2]))
    sparse_map = SparseMap()
    add_view(sparse_map, views[0], np.eye(4))
    sparse_map.points_world[ids[good]] = scale * two_view.points_0[good]
    chosen = [views[0]]
    for view in views[1:-1]:
        chosen += _add_between(sparse_map, view, chosen[-1], camera, config)
    T_1_0 = np.array(two_view.T_1_0)
    T_1_0[:3, 3] *= scale
    add_view(sparse_map, views[-1], T_1_0)
    is_sound = _adjust_all(sparse_map, camera, config)
    return FirstMap(sparse_map, [*chosen, views[-1]]) if is_sound else None


def add_view(sparse_map: SparseMap, view: TrackedView, T_cam_world: Array, position_deviation_deg: float = 0.0) -> int:
    """Adds a tracked view as a keyframe, whose place is known to an angle at the median depth; its index."""
    colors, patches = sample_colors(view.frame, view.tracks.pixels), cut_patches(view.frame.image, view.tracks.pixels)
    frame = view.frame
    ids, pixels = view.tracks.ids, view.ideal_pixels
    return sparse_map.add_keyframe(
        frame.index, frame.timestamp_ns, T_cam_world, ids, pixels, colors, patches, view.image_motion, position_deviation_deg
    )


def _add_between(sparse_map: SparseMap, view: TrackedView, last: TrackedView, camera: Camera, config: Config) -> list[TrackedView]:
    """Adds a view as a keyframe where it has moved enough since the last and can be localised; [view] or []."""
    rows_last, rows = shared_tracks(last, view)
    if median_motion(last.ideal_pixels[rows_last], view.ideal_pixels[rows]) < config.keyframes.motion_px:
        return []
    mapped = sparse_map.is_mapped(view.tracks.ids)
    points = sparse_map.points_world[view.tracks.ids[mapped]]
    found = localize(points, view.ideal_pixels[mapped], None, camera, config.localization, config.seed)
    if not found.converged:
        return []
    add_view(sparse_map, view, found.T_cam_world)
    return [view]


def _adjust_all(sparse_map: SparseMap, camera: Camera, config: Config) -> bool:
    """Two adjustments of the whole young map with outliers removed between; whether it is sound."""
    triangulate_landmarks(sparse_map, camera, config.triangulation)
    window = whole_map(sparse_map)
    rmse = np.inf
    for _ in range(2):
        solved, report = adjust_schur(build_problem(sparse_map, window), camera, config.bundle_adjustment.sigma_px, ADJUSTMENT_ITERATIONS)
        store_solution(sparse_map, window, solved)
        is_outlier = squared_reprojection_errors(solved, camera) > config.bundle_adjustment.outlier_px**2
        sparse_map.remove_observations(solved.obs_rows[is_outlier])
        rmse = report.rmse_px
    enough = np.isfinite(sparse_map.points_world[:, 0]).sum() >= config.initialization.min_tracks
    return bool(enough and rmse < MAX_RMSE_PX and np.isfinite(sparse_map.T_cam_world).all())
