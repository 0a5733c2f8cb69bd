# SPDX-License-Identifier: Apache-2.0
"""The depth views that are in a volume, kept small -> what they say about any points: signed distance and colour."""

from dataclasses import dataclass

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.dense.block_volume import pixel_camera
from vitamin3d.dense.view_store import is_grey
from vitamin3d.geometry.camera import Camera
from vitamin3d.types import Array, DepthView

CODES = 65535
"""Steps of a kept depth; 0: none."""
RUN = 64
"""Points in a row that are left out together where a view cannot show any of them."""
MIXED = (0, 4, 2, 6, 1, 5, 3, 7)
"""The first of every eighth view, in the order in which they are asked."""
FREE = 1e-3
"""Weight of the colour of a view that sees past a point, beside one that sees a surface there."""


@dataclass(frozen=True)
class Seen:
    """What all views together say about N points."""

    distance: Array
    """(N,) float32: mean signed distance along the rays, in truncations, at most 1; NaN: no view saw the point."""
    colors: Array
    """(N, 3) uint8: mean colour; 0 where no view saw the point."""

    @property
    def is_seen(self) -> Array:
        """(N,) bool."""
        return ~np.isnan(self.distance)


@dataclass(frozen=True)
class _Kept:
    T_cam_world: Array
    """(3, 4) float32."""
    depth: Array
    """(H, W) uint16, in `step`."""
    step: float
    color: Array
    """(H, W, 1 or 3) uint8."""

    @property
    def num_bytes(self) -> int:
        return int(self.depth.nbytes + self.color.nbytes)


class FusedViews:
    """Views in order of their fusion. Beyond `max_bytes` every second one is dropped, and of those that follow.

    Args:
        canvas: of the views.
        max_bytes: of all views together.
    """

    def __init__(self, canvas: Camera, max_bytes: float) -> None:
        self._camera = pixel_camera(canvas)
        self._max_bytes = max_bytes
        self._kept: list[_Kept] = []
        self._num_added, self._stride = 0, 1

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def num_bytes(self) -> int:
        """Memory of the views."""
        return sum(kept.num_bytes for kept in self._kept)

    def add(self, view: DepthView, depth: Array) -> None:
        """Keeps a view with those of its depths (H, W) float32 that were fused; 0: none."""
        if self._num_added % self._stride == 0:
            self._kept.append(_packed(view, depth))
        self._num_added += 1
        while len(self._kept) > 1 and self.num_bytes > self._max_bytes:
            self._kept, self._stride = self._kept[::2], 2 * self._stride

    def seen(self, points: Array, truncation: float, enough: int = 1 << 30) -> Seen:
        """What the views say about points (3, N) float32 in the world; the nearer those in a row are to each other the faster.

        A view sees a point that is not farther than `truncation` (map units, along the ray) behind the surface that it shows;
        as in Open3D's volumes, at the pixel in which the point falls (Curless and Levoy 1996). Points in a row of which `enough`
        views saw most are not looked for in the others; the views are taken in an order that mixes early and late ones.
        """
        num_points = points.shape[1]
        spheres, sums = np.empty((-(-num_points // RUN), 4), np.float32), np.zeros((num_points, 3), np.float32)
        shade = np.zeros((num_points, 3), np.float32)
        looks = np.zeros(len(spheres), np.int64)
        _enclose(points, spheres)
        for kept in (kept for first in MIXED for kept in self._kept[first :: len(MIXED)]):
            views = (kept.depth, kept.color, kept.T_cam_world, np.float32(kept.step), self._camera, np.float32(truncation))
            _look(points, spheres, *views, enough, looks, sums, shade)
        distance, colors = np.empty(num_points, np.float32), np.empty((num_points, 3), np.uint8)
        _average(sums, shade, distance, colors)
        return Seen(distance, colors)


def _packed(view: DepthView, depth: Array) -> _Kept:
    codes, color = np.empty(depth.shape, np.uint16), np.ascontiguousarray(view.color)
    step = float(depth.max()) / CODES or 1.0
    _encode(depth.ravel(), np.float32(1.0 / step), codes.ravel())
    color = color[..., :1].copy() if is_grey(color) else color
    return _Kept(np.ascontiguousarray(view.T_cam_world[:3], np.float32), codes, step, color)


@kernel
def _encode(depth, per_step, codes):  # type: ignore[no-untyped-def]
    for n in range(depth.shape[0]):
        codes[n] = max(1.0, np.rint(depth[n] * per_step)) if depth[n] > 0.0 else 0


@kernel
def _enclose(points, spheres):  # type: ignore[no-untyped-def]
    """A sphere (middle, radius) around each run of points."""
    half = np.float32(0.5)
    for m in range(spheres.shape[0]):
        first, last, square = m * RUN, min((m + 1) * RUN, points.shape[1]), np.float32(0.0)
        for axis in range(3):
            low, high = points[axis, first], points[axis, first]
            for n in range(first, last):
                low, high = min(low, points[axis, n]), max(high, points[axis, n])
            spheres[m, axis] = half * (low + high)
            square += (half * (high - low)) ** 2
        spheres[m, 3] = np.sqrt(square)


@inlined
def _may_show(sphere, T, camera, width, height):  # type: ignore[no-untyped-def]
    """Whether a part of the sphere may lie in front of the camera and within the picture's four sides."""
    fx, fy, cx, cy = camera
    r = sphere[3]
    x = T[0, 0] * sphere[0] + T[0, 1] * sphere[1] + T[0, 2] * sphere[2] + T[0, 3]
    y = T[1, 0] * sphere[0] + T[1, 1] * sphere[1] + T[1, 2] * sphere[2] + T[1, 3]
    z = T[2, 0] * sphere[0] + T[2, 1] * sphere[1] + T[2, 2] * sphere[2] + T[2, 3]
    right, bottom = width - cx, height - cy
    if z + r <= 0.0 or fx * x + cx * z < -r * np.sqrt(fx * fx + cx * cx) or fx * x - right * z > r * np.sqrt(fx * fx + right * right):
        return False
    return fy * y + cy * z >= -r * np.sqrt(fy * fy + cy * cy) and fy * y - bottom * z <= r * np.sqrt(fy * fy + bottom * bottom)


@inlined
def _project(X, Y, Z, T, camera, width, height, pixel, far, stretch):  # type: ignore[no-untyped-def]
    """Of each point the pixel that it falls on (-1: none), its depth, and the square of a ray's length per depth.

    Without a branch, so that LLVM does several points at a time.
    """
    fx, fy, cx, cy = camera
    for k in range(X.shape[0]):
        z = T[2, 0] * X[k] + T[2, 1] * Y[k] + T[2, 2] * Z[k] + T[2, 3]
        per_z = np.float32(1.0) / z
        x = (T[0, 0] * X[k] + T[0, 1] * Y[k] + T[0, 2] * Z[k] + T[0, 3]) * per_z
        y = (T[1, 0] * X[k] + T[1, 1] * Y[k] + T[1, 2] * Z[k] + T[1, 3]) * per_z
        u, v = np.floor(fx * x + cx), np.floor(fy * y + cy)
        is_shown = (z > np.float32(0.0)) & (u >= np.float32(0.0)) & (v >= np.float32(0.0)) & (u < width) & (v < height)
        pixel[k] = np.int32(v) * np.int32(width) + np.int32(u) if is_shown else np.int32(-1)
        far[k] = z
        stretch[k] = x * x + y * y + np.float32(1.0)


@kernel
def _look(points, spheres, depth, color, T, step, camera, truncation, enough, looks, sums, shade):  # type: ignore[no-untyped-def]
    """Adds what a view says: to `sums` (N, 3) the distance, 1 for the view and its colour's weight, to `shade` (N, 3) the colour.

    `looks` counts the views that saw at least half of a run.
    """
    width, height = np.float32(depth.shape[1]), np.float32(depth.shape[0])
    depths, colors, last_channel = depth.reshape(-1), color.reshape(-1, color.shape[2]), color.shape[2] - 1
    pixel, far, stretch = np.empty(RUN, np.int32), np.empty(RUN, np.float32), np.empty(RUN, np.float32)
    for m in range(spheres.shape[0]):
        if looks[m] >= enough or not _may_show(spheres[m], T, camera, width, height):
            continue
        first, last = m * RUN, min((m + 1) * RUN, points.shape[1])
        _project(points[0, first:last], points[1, first:last], points[2, first:last], T, camera, width, height, pixel, far, stretch)
        count = 0
        for k in range(last - first):
            p = pixel[k]
            if p < 0 or depths[p] == 0:
                continue
            signed = np.float32(depths[p]) * step - far[k]
            if signed <= -truncation:
                continue
            signed *= np.sqrt(stretch[k]) / truncation
            if signed <= np.float32(-1.0):
                continue
            n, w = first + k, np.float32(1.0) if signed < np.float32(1.0) else np.float32(FREE)
            count += 1
            sums[n, 0] += min(signed, np.float32(1.0))
            sums[n, 1] += np.float32(1.0)
            sums[n, 2] += w
            for c in range(3):
                shade[n, c] += w * np.float32(colors[p, min(c, last_channel)])
        looks[m] += 2 * count >= last - first


@kernel
def _average(sums, shade, distance, colors):  # type: ignore[no-untyped-def]
    for n in range(sums.shape[0]):
        distance[n] = sums[n, 0] / sums[n, 1] if sums[n, 1] > 0.0 else np.nan
        for c in range(3):
            colors[n, c] = np.rint(shade[n, c] / sums[n, 2]) if sums[n, 2] > 0.0 else 0
