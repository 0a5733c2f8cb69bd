# SPDX-License-Identifier: Apache-2.0
"""Landmarks that a keyframe must see but does not observe: more vertices for its mesh (Sec. 4.2, "Meshing").

A landmark that projects into the picture is hidden where something nearer is known there. So it must lie between the
nearest and the farthest of the observed landmarks around it, and these must be of one surface.
"""

import numpy as np
from scipy.spatial import cKDTree

from vitamin3d.config import SnapshotConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.mapping.landmark_statistics import UnitInformation, Vertices, vertices_of
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array


def with_unobserved(
    observed: Vertices, sparse_map: SparseMap, keyframe: int, camera: Camera, config: SnapshotConfig, by_id: UnitInformation | None = None
) -> Vertices:
    """The vertices of a keyframe and, behind them, the landmarks that it sees without having observed them.

    `by_id` is as for `vertices_of`.
    """
    found = vertices_of(sparse_map, _in_the_picture(sparse_map, keyframe, camera), keyframe, camera, config, by_id)
    if len(observed.depths) < config.occlusion_neighbours or len(found.depths) == 0:
        return observed
    visible = is_visible(found, observed, config)
    return Vertices(*(np.concatenate([one, other[visible]]) for one, other in zip(observed, found, strict=True)))


def _in_the_picture(sparse_map: SparseMap, keyframe: int, camera: Camera) -> Array:
    """Ids (N,) of the landmarks in front of the keyframe's camera, within its picture, that have no valid observation there."""
    rows, T = sparse_map.observations_of(keyframe), sparse_map.T_cam_world[keyframe]
    is_wanted = ~np.isnan(sparse_map.points_world[:, 0])
    is_wanted[sparse_map.obs_landmark[rows][sparse_map.obs_valid[rows]]] = False
    ids = np.flatnonzero(is_wanted)
    points = sparse_map.points_world[ids] @ T[:3, :3].T + T[:3, 3]
    in_front = points[:, 2] > 0
    ids, points = ids[in_front], points[in_front]
    with np.errstate(invalid="ignore"):
        return np.asarray(ids[camera.is_inside(camera.distort(camera.ideal_from_points(points)))])


def is_visible(found: Vertices, observed: Vertices, config: SnapshotConfig) -> Array:
    """(N,) bool: landmarks between the depths of the observed ones around them; none where those span a depth edge."""
    distance, near = cKDTree(observed.pixels).query(found.pixels, k=config.occlusion_neighbours)
    around, here = 1.0 / observed.depths[near.reshape(len(found.depths), -1)], 1.0 / found.depths
    low, high = around.min(axis=1), around.max(axis=1)
    is_near = distance.reshape(len(found.depths), -1)[:, -1] < config.occlusion_radius_px
    between = (here > low * (1.0 - config.occlusion_tolerance)) & (here < high * (1.0 + config.occlusion_tolerance))
    return np.asarray(is_near & between & (high < low * (1.0 + config.max_occlusion_range)))
