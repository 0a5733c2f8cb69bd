# SPDX-License-Identifier: Apache-2.0
"""Curvature extrema tracking (Sec. 2.3): predict by the flow (Eq. 4), climb kappa + lambda w (Eq. 5), prune."""

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import ExtremaTrackingConfig
from vitamin3d.image.extrema import is_round, subpixel_offset
from vitamin3d.image.hill_climbing import climb
from vitamin3d.types import Array, DominantFlow, Tracks


@kernel
def _climb_all(kappa, predicted, weight, sigma, max_steps, gate, min_roundness, out, out_kappa, distance):  # type: ignore[no-untyped-def]
    """Climbs from each prediction (N, 2); the distance to a positive maximum, round enough, within `gate` of it, else infinity."""
    height, width = kappa.shape
    for i in range(predicted.shape[0]):
        pu, pv = predicted[i, 0], predicted[i, 1]
        out[i, 0], out[i, 1], out_kappa[i], distance[i] = pu, pv, 0.0, np.inf
        u, v = int(round(pu)), int(round(pv))
        if not (u >= 1 and v >= 1 and u < width - 1 and v < height - 1):
            continue
        u, v, is_maximum = climb(kappa, u, v, pu, pv, weight, sigma * sigma, max_steps)
        if not is_maximum or not kappa[v, u] > 0.0 or not is_round(kappa, u, v, min_roundness):
            continue
        x = u + subpixel_offset(kappa[v, u - 1], kappa[v, u], kappa[v, u + 1])
        y = v + subpixel_offset(kappa[v - 1, u], kappa[v, u], kappa[v + 1, u])
        squared = (x - pu) ** 2 + (y - pv) ** 2
        if squared <= gate * gate:
            out[i, 0], out[i, 1], out_kappa[i], distance[i] = x, y, kappa[v, u], np.sqrt(squared)


@kernel
def _keep_one_per_pixel(ids, pixels, ages, missed, width, keep, owner):  # type: ignore[no-untyped-def]
    """Of the tracks to `keep` that share a pixel, clears all but one: a seen one before a coasting one, then the oldest, then
    the lowest id. `owner` (pixels of the image,) comes as -1."""
    for i in range(ids.shape[0]):
        if not keep[i]:
            continue
        place = int(round(pixels[i, 1])) * width + int(round(pixels[i, 0]))
        j = owner[place]
        if j < 0:
            owner[place] = i
            continue
        is_first = missed[i] < missed[j]
        if missed[i] == missed[j]:
            is_first = ages[i] > ages[j] or (ages[i] == ages[j] and ids[i] < ids[j])
        keep[j if is_first else i] = False
        if is_first:
            owner[place] = i


@kernel
def _sample_flow(flow, reduction, pixels, out):  # type: ignore[no-untyped-def]
    """pixels + bilinear sample of flow (h, w, 2), both in its own pixels, `reduction` of the image's each; clamped."""
    height, width = flow.shape[:2]
    for i in range(pixels.shape[0]):
        x = min(max((pixels[i, 0] + 0.5) / reduction - 0.5, 0.0), width - 1.001)
        y = min(max((pixels[i, 1] + 0.5) / reduction - 0.5, 0.0), height - 1.001)
        u, v = int(x), int(y)
        a, b = x - u, y - v
        for c in range(2):
            top = (1.0 - a) * flow[v, u, c] + a * flow[v, u + 1, c]
            bottom = (1.0 - a) * flow[v + 1, u, c] + a * flow[v + 1, u + 1, c]
            out[i, c] = pixels[i, c] + reduction * ((1.0 - b) * top + b * bottom)


def predict_by_dominant_flow(pixels: Array, flow: DominantFlow) -> Array:
    """Predictions (N, 2) of pixels (N, 2): A x + b (Eq. 4)."""
    return np.asarray(pixels @ flow.A.T + flow.b)


def predict_by_dense_flow(pixels: Array, flow: Array, reduction: int = 1) -> Array:
    """Predictions (N, 2) of pixels (N, 2) by a flow field (H / reduction, W / reduction, 2) in its own pixels."""
    out = np.empty((len(pixels), 2))
    _sample_flow(flow, float(reduction), np.ascontiguousarray(pixels, np.float64), out)
    return out


def _gate(distances: Array, config: ExtremaTrackingConfig) -> float:
    """Pixels: a multiple of the median distance of those reached, within the settings' bounds."""
    reached = distances[np.isfinite(distances)]
    if config.gate_medians == 0.0 or len(reached) == 0:
        return config.gate_px
    return max(config.gate_px, min(config.max_gate_px, config.gate_medians * float(np.median(reached))))


def track_extrema(tracks: Tracks, predicted: Array, kappa: Array, config: ExtremaTrackingConfig) -> Tracks:
    """The tracks in the current image: those found, and those that coast on their prediction.

    Args:
        tracks: of the previous image.
        predicted: (N, 2) their predicted pixels.
        kappa: (H, W) float32 of the current image.

    Returns:
        Tracks, `missed` > 0 where no extremum was found; tracks that meet on one pixel are merged into the oldest.
    """
    n = len(tracks)
    pixels, values, distances = np.empty((n, 2)), np.empty(n, np.float32), np.empty(n)
    weight, sigma, climbable = config.prediction_weight, config.prediction_sigma_px, np.ascontiguousarray(predicted)
    widest = max(config.gate_px, config.max_gate_px if config.gate_medians else 0.0)
    _climb_all(kappa, climbable, weight, sigma, config.max_steps, widest, config.min_roundness, pixels, values, distances)
    found = distances <= _gate(distances[tracks.missed == 0], config)
    pixels = np.where(found[:, None], pixels, predicted)
    missed = np.where(found, np.int32(0), tracks.missed + np.int32(1))
    moved = Tracks(tracks.ids, pixels, np.where(found, values, tracks.kappa), tracks.ages + np.int32(1), missed)
    u, v, (height, width) = pixels[:, 0], pixels[:, 1], kappa.shape
    keep = (missed <= config.coast_frames) & (u > 1) & (v > 1) & (u < width - 2) & (v < height - 2)
    return moved.select(one_per_pixel(moved, np.asarray(keep), (height, width)))


def one_per_pixel(tracks: Tracks, keep: Array, shape: tuple[int, int]) -> Array:
    """(N,) bool: `keep` (N,) with one track per pixel left: a seen one before a coasting one, then the oldest, then the lowest id.

    Args:
        tracks: those to keep lie in the picture.
        shape: of the picture, (height, width).
    """
    kept, owner = keep.copy(), np.full(shape[0] * shape[1], -1, np.int32)
    _keep_one_per_pixel(tracks.ids, tracks.pixels, tracks.ages, tracks.missed, shape[1], kept, owner)
    return np.asarray(kept)
