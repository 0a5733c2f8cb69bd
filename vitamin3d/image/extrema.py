# SPDX-License-Identifier: Apache-2.0
"""Local maxima of the curvature: the features of the method (Sec. 2.1)."""

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.config import ExtremaConfig
from vitamin3d.types import Array

CELL_PX = 32
HIGHEST_BITS, PLACE_BITS = 2**31 - 1, 2**32 - 1


@kernel
def _mark_maxima(kappa, floor, border, is_maximum):  # type: ignore[no-untyped-def]
    """Where kappa is above `floor`, above its four earlier and not below its four later neighbours; False in the border.

    Without branches, so that it runs at SIMD speed.
    """
    height, width = kappa.shape
    is_maximum[:border, :] = False
    is_maximum[height - border :, :] = False
    for v in range(border, height - border):
        for u in range(1, width - 1):  # from a constant: LLVM must see that no index is negative
            k = kappa[v, u]
            earlier = (k <= kappa[v - 1, u - 1]) | (k <= kappa[v - 1, u]) | (k <= kappa[v - 1, u + 1]) | (k <= kappa[v, u - 1])
            later = (k < kappa[v, u + 1]) | (k < kappa[v + 1, u - 1]) | (k < kappa[v + 1, u]) | (k < kappa[v + 1, u + 1])
            is_maximum[v, u] = (k > floor) & ~(earlier | later)
        is_maximum[v, :border] = False
        is_maximum[v, width - border :] = False


@inlined
def roundness(kappa, u, v):  # type: ignore[no-untyped-def]
    """4 det / trace² of the Hessian of kappa at a pixel: 1 at the top of a round hill, 0 on a ridge, whose top slides along it.

    Never above 1; negative where kappa rises between the pixels in one direction, NaN where it is flat.
    """
    uu = kappa[v, u + 1] - 2.0 * kappa[v, u] + kappa[v, u - 1]
    vv = kappa[v + 1, u] - 2.0 * kappa[v, u] + kappa[v - 1, u]
    uv = 0.25 * (kappa[v + 1, u + 1] - kappa[v + 1, u - 1] - kappa[v - 1, u + 1] + kappa[v - 1, u - 1])
    return 4.0 * (uu * vv - uv * uv) / ((uu + vv) * (uu + vv))


@inlined
def is_round(kappa, u, v, min_roundness):  # type: ignore[no-untyped-def]
    """Whether a pixel has at least this roundness; all have, the flat ones too, where it is 0."""
    return min_roundness <= 0.0 or roundness(kappa, u, v) >= min_roundness


@kernel
def _list_marked(kappa, places, min_roundness, extrema, strengths):  # type: ignore[no-untyped-def]
    """(u, v) of those flat pixel indices that are round enough, and kappa there; their number is returned."""
    width, count = kappa.shape[1], 0
    for i in range(places.shape[0]):
        v, u = places[i] // width, places[i] % width
        if not is_round(kappa, u, v, min_roundness):
            continue
        extrema[count, 0], extrema[count, 1] = u, v
        strengths[count] = kappa[v, u]
        count += 1
    return count


@inlined
def subpixel_offset(below, center, above):  # type: ignore[no-untyped-def]
    """Where the parabola through three samples at -1, 0, 1 has its maximum; within half a pixel."""
    bend = below - 2.0 * center + above
    if bend >= 0.0:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (below - above) / bend))


@kernel
def _refine(kappa, extrema, out):  # type: ignore[no-untyped-def]
    for i in range(extrema.shape[0]):
        u, v = extrema[i, 0], extrema[i, 1]
        out[i, 0] = u + subpixel_offset(kappa[v, u - 1], kappa[v, u], kappa[v, u + 1])
        out[i, 1] = v + subpixel_offset(kappa[v - 1, u], kappa[v, u], kappa[v + 1, u])


@kernel
def _free_extrema(extrema, occupied, radius, keep):  # type: ignore[no-untyped-def]
    """Greedy, in the given order: keeps an extremum where nothing is within `radius`, then occupies its place."""
    height, width = occupied.shape
    for i in range(extrema.shape[0]):
        u, v = extrema[i, 0], extrema[i, 1]
        keep[i] = not occupied[v, u]
        if keep[i]:
            occupied[max(0, v - radius) : min(height, v + radius + 1), max(0, u - radius) : min(width, u + radius + 1)] = True


@kernel
def _occupy(pixels, radius, occupied):  # type: ignore[no-untyped-def]
    height, width = occupied.shape
    for i in range(pixels.shape[0]):
        u, v = int(round(pixels[i, 0])), int(round(pixels[i, 1]))
        occupied[max(0, v - radius) : max(0, min(height, v + radius + 1)), max(0, u - radius) : max(0, min(width, u + radius + 1))] = True


def detect_extrema(kappa: Array, config: ExtremaConfig) -> Array:
    """The local maxima (E, 2) int32 `u v` of kappa (H, W) above the noise floor that are round enough, strongest first."""
    is_maximum = np.empty(kappa.shape, np.bool_)
    _mark_maxima(kappa, np.float32(max(0.0, config.min_curvature)), max(1, config.border_px), is_maximum)
    places = np.flatnonzero(is_maximum)
    extrema, strengths = np.empty((len(places), 2), np.int32), np.empty(len(places), np.float32)
    count = _list_marked(kappa, places, config.min_roundness, extrema, strengths)
    return extrema.take(strongest_first(strengths[:count]), axis=0)


def strongest_first(strengths: Array) -> Array:
    """(E,) int64: the order of positive strengths (E,) float32, of equal ones the first first.

    A positive float's bits grow with it: with the place behind them they are integers that numpy sorts twice as fast.
    """
    keys = (HIGHEST_BITS - strengths.view(np.int32).astype(np.int64) << 32) | np.arange(len(strengths))
    keys.sort()
    return np.asarray(keys & PLACE_BITS)


def refine_extrema(kappa: Array, extrema: Array) -> Array:
    """Sub-pixel positions (E, 2) float64 of extrema (E, 2) int by a parabola in each direction."""
    out = np.empty((len(extrema), 2))
    _refine(kappa, extrema, out)
    return out


def select_free_extrema(extrema: Array, live_pixels: Array, shape: tuple[int, int], config: ExtremaConfig) -> Array:
    """Extrema to start as new tracks: away from live tracks, emptiest cells first, strongest first within a cell.

    Args:
        extrema: (E, 2) int32, strongest first.
        live_pixels: (N, 2) positions of the live tracks.
        shape: of the image, (height, width).

    Returns:
        (at most max_tracks - N, 2) int32.
    """
    room = config.max_tracks - len(live_pixels)
    if room <= 0:
        return extrema[:0]
    occupied = np.zeros(shape, np.bool_)
    radius = int(config.min_distance_px) // 2
    _occupy(live_pixels, radius, occupied)
    keep = np.empty(len(extrema), np.bool_)
    _free_extrema(extrema, occupied, radius, keep)
    free = extrema[keep]
    return free[np.argsort(_rank_in_cell(free, live_pixels, shape[1]), kind="stable")[:room]]


def _rank_in_cell(free: Array, live_pixels: Array, width: int) -> Array:
    """For each extremum, how many tracks its cell holds before it: the live ones and the stronger free ones."""
    columns = width // CELL_PX + 1
    cell = (free[:, 1] // CELL_PX) * columns + free[:, 0] // CELL_PX
    live = np.maximum(live_pixels, 0).astype(np.int64) // CELL_PX
    counts = np.bincount(live[:, 1] * columns + live[:, 0], minlength=int(cell.max(initial=0)) + 1)
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], cell[order])
    rank = np.empty(len(free), np.int64)
    rank[order] = np.arange(len(free)) - first
    return np.asarray(rank + counts[cell])
