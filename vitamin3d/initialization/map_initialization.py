# SPDX-License-Identifier: Apache-2.0
"""The first map: the two views' points, the keyframes between them, and an adjustment of it all (Sec. 5.1)."""

from dataclasses import dataclass

import numpy as np

from vitamin3d.bundle_adjustment.schur import adjust_schur
from vitamin3d.bundle_adjustment.variables import squared_reprojection_errors
from vitamin3d.config import Config
from vitamin3d.geometry.cameras import Camera
from vitamin3d.initialization.two_view_initialization import median_motion
from vitamin3d.localization.p3p_localization import localize
from vitamin3d.mapping.keyframe_views import add_view
from vitamin3d.mapping.landmark_triangulation import triangulate_landmarks
from vitamin3d.mapping.window_selection import build_problem, store_solution, whole_map
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, TrackedView, TwoView, shared_tracks

ADJUSTMENT_ITERATIONS = 20
MAX_RMSE_PX = 2.0


@dataclass(frozen=True)
class FirstMap:
    """A map with its keyframes' views, the reference's camera being the world, the median depth there 1."""

    map: SparseMap
    keyframe_views: list[TrackedView]


def build_first_map(
    two_view: TwoView, ids: Array, views: list[TrackedView], camera: Camera, config: Config, first_id: int = 0
) -> FirstMap | None:
    """The map of the reference, the newest view and the keyframes between them; None where it does not hold together.

    Args:
        two_view: of views[0] and views[-1].
        ids: (N,) track ids of its points.
        views: from the reference to the newest.
        first_id: the least id that a track of the map may have.
    """
    good = np.isfinite(two_view.points_0[:, 0])
    scale = 1.0 / float(np.median(two_view.points_0[good, 2]))
    sparse_map = SparseMap(first_id)
    add_view(sparse_map, views[0], np.eye(4))
    sparse_map.points_world[sparse_map.rows_of(ids[good])] = scale * two_view.points_0[good]
    chosen = [views[0]]
    for view in views[1:-1]:
        chosen += _add_between(sparse_map, view, chosen[-1], camera, config)
    T_1_0 = np.array(two_view.T_1_0)
    T_1_0[:3, 3] *= scale
    add_view(sparse_map, views[-1], T_1_0)
    is_sound = _adjust_all(sparse_map, camera, config)
    return FirstMap(sparse_map, [*chosen, views[-1]]) if is_sound else None


def _add_between(sparse_map: SparseMap, view: TrackedView, last: TrackedView, camera: Camera, config: Config) -> list[TrackedView]:
    """Adds a view as a keyframe where it has moved enough since the last and can be localised; [view] or []."""
    rows_last, rows = shared_tracks(last, view)
    if median_motion(last.ideal_pixels[rows_last], view.ideal_pixels[rows]) < config.keyframes.motion_px:
        return []
    is_mapped, rows_mapped = sparse_map.mapped(view.tracks.ids)
    found = localize(sparse_map.points_world[rows_mapped], view.ideal_pixels[is_mapped], None, camera, config.localization, config.seed)
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
    enough = len(sparse_map.landmarks) >= config.initialization.min_tracks
    return bool(enough and rmse < MAX_RMSE_PX and np.isfinite(sparse_map.T_cam_world).all())
