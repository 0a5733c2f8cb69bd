# SPDX-License-Identifier: Apache-2.0
"""Landmarks that come back into view are found again: project, climb kappa, compare a patch, take up."""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import RecoveryConfig
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.rolling_shutter import measured_pixels
from vitamin3d.geometry.se3 import inverse
from vitamin3d.image.extrema import subpixel_offset
from vitamin3d.image.hill_climbing import climb
from vitamin3d.image.patches import cut_patches, patch_similarity
from vitamin3d.sparse_map import SparseMap
from vitamin3d.types import Array, Tracks

BORDER_PX = 10


@kernel
def _climb_strict(kappa, predicted, max_steps, gate, out, found):  # type: ignore[no-untyped-def]
    """The maximum of kappa that plain hill climbing reaches from each pixel (N, 2), within the gate."""
    for i in range(predicted.shape[0]):
        pu, pv = predicted[i, 0], predicted[i, 1]
        u, v, is_maximum = climb(kappa, int(round(pu)), int(round(pv)), pu, pv, 0.0, 1.0, max_steps)
        found[i] = False
        if is_maximum and kappa[v, u] > 0.0:
            out[i, 0] = u + subpixel_offset(kappa[v, u - 1], kappa[v, u], kappa[v, u + 1])
            out[i, 1] = v + subpixel_offset(kappa[v - 1, u], kappa[v, u], kappa[v + 1, u])
            found[i] = (out[i, 0] - pu) ** 2 + (out[i, 1] - pv) ** 2 <= gate * gate


@kernel
def _list_candidates(  # type: ignore[no-untyped-def]
    points, num_observations, last_observation, is_live, keyframe_starts, centres, pose, view, min_observations, min_cosine, max_ratio, rows
):
    """Writes the rows of landmarks that `_visible_candidates` is about, and returns how many; `view` is fx fy cx cy width height,
    `centres` (K + 1, 3) those of the keyframes' cameras and of this one in the world."""
    fx, fy, cx, cy, width, height = view
    count, here = 0, centres[-1]
    for p in range(points.shape[0]):  # without a branch; NaN is not in the picture
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) + cx * depth
        v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) + cy * depth
        is_shown = (depth > 0.0) & (u > 0.0) & (v > 0.0) & (u < width * depth) & (v < height * depth)
        rows[count] = p
        count += is_shown & (not is_live[p]) & (num_observations[p] >= min_observations)
    shown, count = rows[:count], 0
    for p in shown:
        k, span = 0, keyframe_starts.shape[0]  # the keyframe of the last observation, by bisection without a branch
        while span > 1:
            half = span >> 1
            k += half * (keyframe_starts[k + half] <= last_observation[p])
            span -= half
        dot, squared_then, squared_now = 0.0, 0.0, 0.0
        for i in range(3):
            a, b = points[p, i] - centres[k, i], points[p, i] - here[i]
            dot, squared_then, squared_now = dot + a * b, squared_then + a * a, squared_now + b * b
        is_alike = dot > min_cosine * np.sqrt(squared_then * squared_now)
        if is_alike and squared_now < max_ratio**2 * squared_then and squared_then < max_ratio**2 * squared_now:
            rows[count] = p
            count += 1
    return count


def _visible_candidates(sparse_map: SparseMap, live: Array, T_cam_world: Array, camera: Camera, config: RecoveryConfig) -> Array:
    """Rows of landmarks, not among the `live` rows (N,), that were last seen from a similar direction and distance."""
    size, canvas = len(sparse_map.points_world), camera.whole_canvas
    view = *canvas.intrinsics, canvas.width, canvas.height
    is_live, rows = np.zeros(size, np.bool_), np.empty(size, np.int64)
    is_live[live[(live >= 0) & (live < size)]] = True
    centres = np.ascontiguousarray(inverse(np.concatenate([sparse_map.T_cam_world, T_cam_world[None]]))[:, :3, 3])
    count = _list_candidates(
        sparse_map.points_world, sparse_map.num_observations, sparse_map.last_observation, is_live, np.array(sparse_map.keyframe_starts),
        centres, np.ascontiguousarray(T_cam_world), view,
        config.min_observations, np.cos(np.radians(config.max_view_angle_deg)), config.max_distance_ratio, rows,
    )  # fmt: skip
    return rows[:count]


def recover_landmarks(
    tracks: Tracks, sparse_map: SparseMap, image: Array, kappa: Array, image_motion: Array, T_cam_world: Array, camera: Camera,
    config: RecoveryConfig, noise: float = 0.0,
) -> tuple[Tracks, Array]:  # fmt: skip
    """The tracks with those landmarks added that came back into view, and the ids (N, 2) of landmarks that met tracked ones there.

    A landmark is taken up where its projection climbs to a maximum of kappa within the gate and the patch of its last
    keyframe agrees. It takes the place of a track that is no landmark; where a landmark is already tracked, it stays.

    Args:
        image: (H, W) uint8 picture of the frame.
        kappa: (H, W) float32 of the frame.
        image_motion: (6, 2) of the frame.
        T_cam_world: (4, 4) of the frame.
        noise: deviation of the picture's noise, grey levels.
    """
    live = sparse_map.rows_of(tracks.ids)
    rows = _visible_candidates(sparse_map, live, T_cam_world, camera, config)
    points = sparse_map.points_world.take(rows, axis=0)
    ideal = camera.ideal_from_points(points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
    predicted = measured_pixels(ideal, image_motion, camera)
    inside = camera.is_inside(predicted, BORDER_PX)
    rows, predicted = rows[inside], np.ascontiguousarray(predicted[inside])
    pixels, found = np.empty_like(predicted), np.empty(len(predicted), np.bool_)
    _climb_strict(kappa, predicted, int(config.gate_px) + 2, config.gate_px, pixels, found)
    rows, pixels = rows[found], pixels[found]
    agrees = patch_similarity(sparse_map.patches[rows], cut_patches(image, pixels), noise) > config.min_zncc
    return _take_up(tracks, sparse_map.is_mapped(live), sparse_map.ids_of(rows[agrees]), pixels[agrees], kappa)


def _take_up(tracks: Tracks, is_mapped: Array, ids: Array, pixels: Array, kappa: Array) -> tuple[Tracks, Array]:
    """Adds landmarks `ids` at `pixels`; per pixel a live landmark stays, else the oldest of the new ones comes.

    Returns:
        The tracks, and per pixel where a live landmark stayed the oldest of the new ones and its id (N, 2).
    """
    width = kappa.shape[1]
    unit = np.array([1, width])
    place, live_place = np.rint(pixels).astype(np.int64) @ unit, np.rint(tracks.pixels).astype(np.int64) @ unit
    seen = is_mapped & (tracks.missed == 0)
    _, new, live = np.intersect1d(place, live_place[seen], return_indices=True)
    meetings = np.stack([ids[new], tracks.ids[seen][live]], axis=1)
    free = ~np.isin(place, live_place[is_mapped], kind="table")
    ids, pixels, place = ids[free], pixels[free], place[free]
    _, first = np.unique(place, return_index=True)
    ids, pixels, place = ids[first], pixels[first], place[first]
    remaining = tracks.select(~np.isin(live_place, place, kind="table"))
    at = np.rint(pixels).astype(np.int64)
    ages, missed = np.zeros(len(ids), np.int32), np.zeros(len(ids), np.int32)
    return Tracks.concatenate(remaining, Tracks(ids, pixels, kappa[at[:, 1], at[:, 0]], ages, missed)), meetings


def same_landmarks(meetings: Array, tracks: Tracks, sparse_map: SparseMap, T_cam_world: Array, max_distance: float) -> Array:
    """Of landmarks that met tracked ones, ids (N, 2), the pairs (M, 2) that are one: near each other in space, relative to their depth.

    With a largest distance of 0 there are none.
    """
    if max_distance == 0.0:
        return np.zeros((0, 2), np.int64)
    usable = sparse_map.mapped(meetings[:, 0])[0] & sparse_map.mapped(meetings[:, 1])[0]
    usable &= np.isin(meetings[:, 1], tracks.ids) & ~np.isin(meetings[:, 0], tracks.ids)
    pairs = meetings[usable]
    a, b = (sparse_map.points_world[sparse_map.rows_of(ids)] for ids in pairs.T)
    depth = b @ T_cam_world[2, :3] + T_cam_world[2, 3]
    pairs = pairs[np.linalg.norm(a - b, axis=1) < max_distance * depth]
    for column in (0, 1):
        pairs = pairs[np.unique(pairs[:, column], return_index=True)[1]]
    return np.asarray(pairs[~np.isin(pairs[:, 0], pairs[:, 1])])
