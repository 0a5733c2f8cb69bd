# SPDX-License-Identifier: Apache-2.0
"""Landmarks that come back into view are found again: project, climb kappa, compare a patch, take up."""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import RecoveryConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.geometry.rolling_shutter import measured_pixels
from vitamin3d.geometry.se3 import inverse
from vitamin3d.mapping.sparse_map import PATCH_PX, SparseMap
from vitamin3d.tracking.extrema import subpixel_offset
from vitamin3d.tracking.extrema_tracking import climb
from vitamin3d.types import Array, Tracks

BORDER_PX = 10


@kernel
def _cut_patches(image, pixels, radius, out):  # type: ignore[no-untyped-def]
    """Patches (N, P) uint8 around rounded pixels, clamped at the border."""
    height, width = image.shape
    for i in range(pixels.shape[0]):
        u, v = int(round(pixels[i, 0])), int(round(pixels[i, 1]))
        k = 0
        for n in range(v - radius, v + radius + 1):
            for m in range(u - radius, u + radius + 1):
                out[i, k] = image[min(max(n, 0), height - 1), min(max(m, 0), width - 1)]
                k += 1


@kernel
def _zncc(a, b, out):  # type: ignore[no-untyped-def]
    """Zero-mean normalised cross-correlation of patches (N, P) row by row; 0 where one has no contrast."""
    for i in range(a.shape[0]):
        n = a.shape[1]
        sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            x, y = float(a[i, k]), float(b[i, k])
            sa, sb, saa, sbb, sab = sa + x, sb + y, saa + x * x, sbb + y * y, sab + x * y
        variance = (saa - sa * sa / n) * (sbb - sb * sb / n)
        out[i] = (sab - sa * sb / n) / np.sqrt(variance) if variance > 1e-6 else 0.0


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


def cut_patches(image: Array, pixels: Array) -> Array:
    """Patches (N, 81) uint8 of a picture (H, W) uint8 around distorted pixels (N, 2)."""
    out = np.empty((len(pixels), PATCH_PX * PATCH_PX), np.uint8)
    _cut_patches(image, np.ascontiguousarray(pixels), PATCH_PX // 2, out)
    return out


def patch_similarity(a: Array, b: Array) -> Array:
    """Zero-mean normalised cross-correlation (N,) of patches (N, P) uint8, in [-1, 1]."""
    out = np.empty(len(a))
    _zncc(a, b, out)
    return out


def _visible_candidates(sparse_map: SparseMap, live_ids: Array, T_cam_world: Array, camera: Camera, config: RecoveryConfig) -> Array:
    """Ids of landmarks, not tracked now, that were last seen from a similar direction and distance."""
    wanted = (sparse_map.num_observations >= config.min_observations) & ~np.isnan(sparse_map.points_world[:, 0])
    wanted[live_ids[live_ids < len(wanted)]] = False
    ids = np.flatnonzero(wanted)
    points = sparse_map.points_world[ids]
    in_camera = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    canvas = camera.canvas()
    u = camera.fx * in_camera[:, 0] + (canvas.cx) * in_camera[:, 2]
    v = camera.fy * in_camera[:, 1] + (canvas.cy) * in_camera[:, 2]
    z = in_camera[:, 2]
    front = (z > 0) & (u > 0) & (v > 0) & (u < canvas.width * z) & (v < canvas.height * z)
    ids, points = ids[front], points[front]
    centers = inverse(sparse_map.T_cam_world)[:, :3, 3]
    then = points - centers[sparse_map.keyframe_of(sparse_map.last_observation[ids])]
    now = points - inverse(T_cam_world)[:3, 3]
    distance_then, distance_now = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
    similar = (then * now).sum(axis=1) > np.cos(np.radians(config.max_view_angle_deg)) * distance_then * distance_now
    ratio = distance_now / np.maximum(distance_then, 1e-12)
    return np.asarray(ids[similar & (ratio < config.max_distance_ratio) & (ratio > 1.0 / config.max_distance_ratio)])


def recover_landmarks(
    tracks: Tracks, sparse_map: SparseMap, image: Array, kappa: Array, image_motion: Array, T_cam_world: Array, camera: Camera,
    config: RecoveryConfig,
) -> tuple[Tracks, Array]:  # fmt: skip
    """The tracks with those landmarks added that came back into view, and the ids (N, 2) of landmarks that met tracked ones there.

    A landmark is taken up where its projection climbs to a maximum of kappa within the gate and the patch of its last
    keyframe agrees. It takes the place of a track that is no landmark; where a landmark is already tracked, it stays.

    Args:
        image: (H, W) uint8 picture of the frame.
        kappa: (H, W) float32 of the frame.
        image_motion: (6, 2) of the frame.
        T_cam_world: (4, 4) of the frame.
    """
    ids = _visible_candidates(sparse_map, tracks.ids, T_cam_world, camera, config)
    points = sparse_map.points_world[ids]
    ideal = camera.ideal_from_points(points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
    predicted = measured_pixels(ideal, image_motion, camera)
    inside = camera.is_inside(predicted, BORDER_PX)
    ids, predicted = ids[inside], np.ascontiguousarray(predicted[inside])
    pixels, found = np.empty_like(predicted), np.empty(len(predicted), np.bool_)
    _climb_strict(kappa, predicted, int(config.gate_px) + 2, config.gate_px, pixels, found)
    ids, pixels = ids[found], pixels[found]
    agrees = patch_similarity(sparse_map.patches[ids], cut_patches(image, pixels)) > config.min_zncc
    ids, pixels = ids[agrees], pixels[agrees]
    return _take_up(tracks, sparse_map.is_mapped(tracks.ids), ids, pixels, kappa)


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
    free = ~np.isin(place, live_place[is_mapped])
    ids, pixels, place = ids[free], pixels[free], place[free]
    _, first = np.unique(place, return_index=True)
    ids, pixels, place = ids[first], pixels[first], place[first]
    remaining = tracks.select(~np.isin(live_place, place))
    at = np.rint(pixels).astype(np.int64)
    ages, missed = np.zeros(len(ids), np.int32), np.zeros(len(ids), np.int32)
    return Tracks.concatenate(remaining, Tracks(ids, pixels, kappa[at[:, 1], at[:, 0]], ages, missed)), meetings


def same_landmarks(meetings: Array, tracks: Tracks, sparse_map: SparseMap, T_cam_world: Array, max_distance: float) -> Array:
    """Of landmarks that met tracked ones (N, 2) the pairs (M, 2) that are one: near each other in space, relative to their depth."""
    usable = sparse_map.is_mapped(meetings[:, 0]) & sparse_map.is_mapped(meetings[:, 1])
    usable &= np.isin(meetings[:, 1], tracks.ids) & ~np.isin(meetings[:, 0], tracks.ids)
    pairs = meetings[usable]
    a, b = sparse_map.points_world[pairs[:, 0]], sparse_map.points_world[pairs[:, 1]]
    depth = b @ T_cam_world[2, :3] + T_cam_world[2, 3]
    pairs = pairs[np.linalg.norm(a - b, axis=1) < max_distance * depth]
    for column in (0, 1):
        pairs = pairs[np.unique(pairs[:, column], return_index=True)[1]]
    return np.asarray(pairs[~np.isin(pairs[:, 0], pairs[:, 1])])
