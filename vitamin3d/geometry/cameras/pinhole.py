# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera with radial-tangential distortion (Brown–Conrady, OpenCV's k1 k2 p1 p2, EuRoC's `sensor.yaml`)."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d.geometry.cameras.protocol import Camera
from vitamin3d.types import Array

NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-10
BLOCK = 64
"""Points that Newton's method moves together."""


@inlined
def distort(x, y, k1, k2, p1, p2):  # type: ignore[no-untyped-def]
    """Normalised distorted coordinates of normalised ideal ones."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * k2)
    return x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y


@kernel
def _distort_pixels(pixels, model, out):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy, k1, k2, p1, p2 = model
    for i in range(pixels.shape[0]):
        x, y = distort((pixels[i, 0] - cx) / fx, (pixels[i, 1] - cy) / fy, k1, k2, p1, p2)
        out[i, 0], out[i, 1] = fx * x + cx, fy * y + cy


@kernel
def _undistort_pixels(pixels, model, steps, tolerance, out):  # type: ignore[no-untyped-def]
    """Newton's method on the distortion; NaN beyond the fold of the model: no root, or one on the other side of the centre.

    A step of many points at a time, without branches: a loop that LLVM vectorises."""
    fx, fy, cx, cy, k1, k2, p1, p2 = model
    xd, yd, xs, ys, error = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for first in range(0, pixels.shape[0], BLOCK):
        count = min(BLOCK, pixels.shape[0] - first)
        for i in range(count):
            xd[i], yd[i] = (pixels[first + i, 0] - cx) / fx, (pixels[first + i, 1] - cy) / fy
            xs[i], ys[i] = xd[i], yd[i]
        for _ in range(steps):
            for i in range(count):
                x, y = xs[i], ys[i]
                x_there, y_there = distort(x, y, k1, k2, p1, p2)
                ex, ey = x_there - xd[i], y_there - yd[i]
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * k2)
                slope = 2.0 * k1 + 4.0 * k2 * r2
                jxx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
                jxy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
                jyy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
                det = jxx * jyy - jxy * jxy
                error[i] = ex * ex + ey * ey
                share = 1.0 / det if det > 0.0 and error[i] >= tolerance * tolerance else 0.0
                xs[i], ys[i] = x - (jyy * ex - jxy * ey) * share, y - (jxx * ey - jxy * ex) * share
            worst = 0.0
            for i in range(count):
                worst = max(worst, error[i])
            if worst < tolerance * tolerance:
                break
        for i in range(count):
            is_root = error[i] < 1e-12 and xs[i] * xd[i] + ys[i] * yd[i] >= 0.0
            out[first + i, 0] = fx * xs[i] + cx if is_root else np.nan
            out[first + i, 1] = fy * ys[i] + cy if is_root else np.nan


@dataclass(frozen=True)
class PinholeCamera:
    """A calibrated camera: intrinsics in pixels, distortion, picture size. What its methods do is said by `Camera`."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2."""
    readout_s: float = 0.0
    """Seconds from the first to the last row of a rolling shutter (`geometry/rolling_shutter.py`); 0: all at once."""

    @property
    def K(self) -> Array:
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> Array:
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def model(self) -> Array:
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])

    @property
    def parameters(self) -> dict[str, float]:
        """By name, pixels; distortion without unit."""
        return dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), self.model.tolist(), strict=True))

    @property
    def half_field(self) -> tuple[float, float]:
        return 0.5 * self.width / self.fx, 0.5 * self.height / self.fy

    def radians(self, pixels: float) -> float:
        return pixels / self.fx

    def with_readout(self, readout_s: float) -> "PinholeCamera":
        return replace(self, readout_s=readout_s)

    def with_model(self, model: Array) -> "PinholeCamera":
        fx, fy, cx, cy, k1, k2, p1, p2 = (float(value) for value in model)
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, distortion=(k1, k2, p1, p2))

    @property
    def is_distorted(self) -> bool:
        return any(self.distortion)

    def project(self, points_cam: Array) -> Array:
        return self.distort(self.ideal_from_points(points_cam))

    def unproject(self, pixels: Array) -> Array:
        return self.rays_from_ideal(self.undistort(pixels))

    def pose_jacobians(self, points_cam: Array) -> tuple[Array, Array]:
        x, y, depth = points_cam[:, 0] / points_cam[:, 2], points_cam[:, 1] / points_cam[:, 2], points_cam[:, 2]
        zero = np.zeros_like(x)
        J_u = self.fx * np.stack([1.0 / depth, zero, -x / depth, -x * y, 1.0 + x * x, -y], axis=1)
        J_v = self.fy * np.stack([zero, 1.0 / depth, -y / depth, -1.0 - y * y, x * y, x], axis=1)
        return J_u, J_v

    def ideal_from_points(self, points_cam: Array) -> Array:
        z = np.where(points_cam[:, 2] > 0, points_cam[:, 2], np.nan)
        return np.stack([self.fx * points_cam[:, 0] / z + self.cx, self.fy * points_cam[:, 1] / z + self.cy], axis=1)

    def rays_from_ideal(self, pixels: Array) -> Array:
        return np.stack([(pixels[:, 0] - self.cx) / self.fx, (pixels[:, 1] - self.cy) / self.fy, np.ones(len(pixels))], axis=1)

    def undistort(self, pixels: Array) -> Array:
        return self._mapped(pixels, inverse=True)

    def distort(self, pixels: Array) -> Array:
        return self._mapped(pixels, inverse=False)

    def _mapped(self, pixels: Array, inverse: bool) -> Array:
        if not self.is_distorted:
            return np.array(pixels, np.float64)
        pixels = np.ascontiguousarray(pixels, np.float64)
        out = np.empty_like(pixels)
        if inverse:
            _undistort_pixels(pixels, self.model, NEWTON_STEPS, NEWTON_TOLERANCE, out)
        else:
            _distort_pixels(pixels, self.model, out)
        return out

    def is_inside(self, pixels: Array, margin: float = 0.0) -> Array:
        u, v = pixels[:, 0], pixels[:, 1]
        return np.asarray((u >= margin) & (v >= margin) & (u <= self.width - 1 - margin) & (v <= self.height - 1 - margin))

    def canvas(self, limit: float = 0.5) -> "PinholeCamera":
        """The undistorted camera that holds the whole picture: the same focal lengths, a wider image.

        The canvas grows on each side by at most `limit` times the picture's size, for lenses whose corners
        lie far outside.
        """
        if not self.is_distorted:
            return PinholeCamera(self.fx, self.fy, self.cx, self.cy, self.width, self.height)
        us, vs = np.arange(self.width, dtype=float), np.arange(self.height, dtype=float)
        border = np.concatenate(
            [np.stack(np.broadcast_arrays(u, v), -1) for u, v in ((us, 0.0), (us, self.height - 1.0), (0.0, vs), (self.width - 1.0, vs))]
        )
        ideal = self.undistort(border)
        size = np.array([self.width, self.height], float)
        low = np.maximum(np.floor(np.nanmin(ideal, axis=0)), -np.ceil(limit * size))
        high = np.minimum(np.ceil(np.nanmax(ideal, axis=0)), size - 1 + np.ceil(limit * size))
        left, top = np.minimum(low, 0.0)
        width, height = (np.maximum(high, size - 1) - np.minimum(low, 0.0) + 1).astype(int)
        return PinholeCamera(self.fx, self.fy, float(self.cx - left), float(self.cy - top), int(width), int(height))

    def scaled(self, factor: float) -> "PinholeCamera":
        cx, cy = (factor * (center + 0.5) - 0.5 for center in (self.cx, self.cy))
        return PinholeCamera(factor * self.fx, factor * self.fy, cx, cy, round(factor * self.width), round(factor * self.height))

    def cropped(self, width: int, height: int) -> "PinholeCamera":
        return replace(self, width=width, height=height)

    def ideal_in(self, other: Camera, pixels: Array) -> Array:
        there = other.intrinsics
        factors = there[:2] / [self.fx, self.fy]
        return np.asarray(factors * (pixels - [self.cx, self.cy]) + there[2:])

    @cached_property
    def whole_canvas(self) -> "PinholeCamera":
        return self.canvas()

    def canvas_maps(self, canvas: Camera) -> tuple[Array, Array]:
        grid = np.stack(np.meshgrid(np.arange(canvas.width, dtype=float), np.arange(canvas.height, dtype=float)), -1).reshape(-1, 2)
        ideal = canvas.rays_from_ideal(grid)[:, :2] * [self.fx, self.fy] + [self.cx, self.cy]
        source = self.distort(ideal)
        returned = np.abs(self.undistort(source) - ideal).max(axis=1) < 0.5
        source[~returned] = -10.0
        source = source.reshape(canvas.height, canvas.width, 2).astype(np.float32)
        return np.ascontiguousarray(source[..., 0]), np.ascontiguousarray(source[..., 1])

    def draw_on_canvas(self, image: Array, maps: tuple[Array, Array]) -> Array:
        return np.asarray(cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR))
