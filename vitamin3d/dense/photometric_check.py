# SPDX-License-Identifier: Apache-2.0
"""Triangles that other pictures do not confirm: warped by the triangle's depths, another view shows something else there.

Where landmarks before and behind a depth edge are joined, a triangle closes free space like a web. Views near each other
join the same landmarks, so their depths agree on the web (`consistency.py`); their pictures do not.
"""

from dataclasses import replace

import numpy as np

from vitamin3d._jit import kernel
from vitamin3d.config import PhotometricConfig
from vitamin3d.dense.depth_rendering import DepthRenderer, rasterize
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array, DepthView, ImageMesh


def is_doubtful(mesh: ImageMesh, config: PhotometricConfig) -> Array:
    """(F,) bool: triangles whose inverse depths differ, or whose vertices are far apart."""
    corners = mesh.inverse_depth[mesh.triangles]
    points = mesh.pixels[mesh.triangles]
    longest = np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2).max(axis=1)
    is_steep = np.ptp(corners, axis=1) > config.min_inverse_depth_range * corners.mean(axis=1)
    return np.asarray(is_steep | (longest > config.min_edge_px))


def triangle_numbers(pixels: Array, triangles: Array, width: int, height: int) -> Array:
    """(height, width) int32: the number of the triangle (F, 3) that covers a pixel, from 1; 0 where there is none."""
    corners = pixels[triangles].reshape(-1, 2)
    apart = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    numbers = np.repeat(np.arange(1.0, len(triangles) + 1.0), 3)[:, None]
    return np.asarray(np.rint(rasterize(corners, apart, numbers, width, height)[..., 0]).astype(np.int32))


def marked(view: DepthView, mesh: ImageMesh, renderer: DepthRenderer, config: PhotometricConfig) -> DepthView:
    """The view with the numbers of its doubtful triangles at their pixels."""
    canvas, camera = renderer.canvas, renderer.camera
    pixels = camera.ideal_in(canvas, mesh.pixels)
    numbers = triangle_numbers(pixels, mesh.triangles[is_doubtful(mesh, config)], canvas.width, canvas.height)
    return replace(view, doubtful=numbers)


@kernel
def _warped_sums(depth, numbers, gray, is_outside, other_depth, other_gray, T, intrinsics, tolerance, sums):  # type: ignore[no-untyped-def]
    """Adds 1, a, b, a², b², ab to `sums` (F + 1, 6) of each pixel's triangle: grey levels here and, warped, in the other view.

    Left out are pixels that the other view does not see, or before which it has something nearer.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    for v in range(height):
        for u in range(width):
            f, d = numbers[v, u], depth[v, u]
            if f == 0 or not d > 0.0:
                continue
            p, q = (u - cx) / fx * d, (v - cy) / fy * d
            z = T[2, 0] * p + T[2, 1] * q + T[2, 2] * d + T[2, 3]
            if z <= 0.0:
                continue
            x = fx * (T[0, 0] * p + T[0, 1] * q + T[0, 2] * d + T[0, 3]) / z + cx
            y = fy * (T[1, 0] * p + T[1, 1] * q + T[1, 2] * d + T[1, 3]) / z + cy
            if not (0.0 <= x < width - 1 and 0.0 <= y < height - 1):
                continue
            m, n = int(x), int(y)
            if is_outside[n, m] or is_outside[n, m + 1] or is_outside[n + 1, m] or is_outside[n + 1, m + 1]:
                continue
            nearest = other_depth[int(y + 0.5), int(x + 0.5)]
            if 0.0 < nearest < (1.0 - tolerance) * z:
                continue
            s, t = x - m, y - n
            above = (1.0 - s) * other_gray[n, m] + s * other_gray[n, m + 1]
            b = (1.0 - t) * above + t * ((1.0 - s) * other_gray[n + 1, m] + s * other_gray[n + 1, m + 1])
            a = float(gray[v, u])
            sums[f, 0] += 1.0
            sums[f, 1] += a
            sums[f, 2] += b
            sums[f, 3] += a * a
            sums[f, 4] += b * b
            sums[f, 5] += a * b


def correlations(view: DepthView, other: DepthView, canvas: Camera, is_outside: Array, config: PhotometricConfig) -> Array:
    """(F + 1,) correlation of the two pictures in each numbered triangle of the view, NaN where nothing can be said.

    That is where the other view shows too little of it, or both pictures are flat there.
    """
    sums = np.zeros((int(view.doubtful.max(initial=0)) + 1, 6))
    T_other_view = np.ascontiguousarray(other.T_cam_world @ inverse(view.T_cam_world))
    gray, other_gray = (np.ascontiguousarray(v.color[..., 1]) for v in (view, other))
    _warped_sums(
        view.depth, view.doubtful, gray, is_outside, other.depth, other_gray, T_other_view, canvas.intrinsics, config.tolerance, sums
    )
    count = np.maximum(sums[:, 0], 1.0)
    a, b, aa, bb, ab = (sums[:, k] / count for k in range(1, 6))
    variance_a, variance_b, covariance = aa - a * a, bb - b * b, ab - a * b
    clear = (sums[:, 0] >= config.min_pixels) & (0.5 * (variance_a + variance_b) >= config.min_contrast**2)
    found = covariance / np.sqrt(np.maximum(variance_a, 1.0) * np.maximum(variance_b, 1.0))
    return np.where(clear, found, np.nan)


def photometrically_checked(
    view: DepthView, others: list[DepthView], canvas: Camera, is_outside: Array, config: PhotometricConfig
) -> DepthView:
    """The view without the doubtful triangles whose pictures do not correlate in any two of the others."""
    if not view.doubtful.any() or not others:
        return view
    scores = np.stack([correlations(view, other, canvas, is_outside, config) for other in others])
    ranked = np.sort(np.where(np.isnan(scores), -np.inf, scores), axis=0)[::-1]
    best = ranked[min(1, len(ranked) - 1)]
    seen = np.isfinite(scores).sum(axis=0) >= min(2, len(others))
    rejected = (seen & (best < config.min_correlation))[view.doubtful]
    return replace(view, depth=np.where(rejected, np.float32(0.0), view.depth), weights=np.where(rejected, np.float32(0.0), view.weights))
