# SPDX-License-Identifier: Apache-2.0
"""More vertices than landmarks: depths of textured pixels, from a keyframe and its neighbours.

A sweep over planes on the reduced pictures says where a pixel of each cell lies; where it says so distinctly, patches of
the full pictures refine it along the epipolar lines. What is found joins the landmarks as vertices of the mesh, each with
the deviation that its parallax leaves.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from vitamin3d._jit import inlined, kernel
from vitamin3d._simd import WIDE, load_f32, splat_f32, store, total_f32
from vitamin3d.config import DensificationConfig
from vitamin3d.dense.plane_sweep import PlaneSweep, SweptDepth, turned
from vitamin3d.dense.view_graph import Neighbourhood
from vitamin3d.geometry.cameras import Camera
from vitamin3d.geometry.se3 import inverse
from vitamin3d.types import Array, Frame, MapSnapshot

REDUCTION = 2
REFINEMENT_STEPS, REFINEMENT_STEP_PX = 4, 0.7
"""The patches are compared at so many steps to each side of the swept depth."""
MIN_PATCH_DEVIATION = 2.0
"""Grey levels; flatter patches are not compared."""


class CanvasPicture:
    """A keyframe to be compared with others; its pictures are drawn when they are first asked for: many are neighbours of none.

    Args:
        draw: a frame's picture (H, W) uint8 on the canvas.
        is_outside: (H, W) bool, where on the canvas there is no picture.
    """

    def __init__(self, snapshot: MapSnapshot, draw: Callable[[Frame], Array], is_outside: Array) -> None:
        self.snapshot, self._draw, self._is_outside = snapshot, draw, is_outside

    @property
    def image(self) -> Array:
        """(H, W) uint8 on the canvas, 0 = no picture."""
        return self._pictures[0]

    @property
    def reduced(self) -> Array:
        """(H / 2, W / 2) uint8."""
        return self._pictures[1]

    @cached_property
    def _pictures(self) -> tuple[Array, Array]:
        image = np.ascontiguousarray(self._draw(self.snapshot.frame))
        height, width = (n // REDUCTION for n in image.shape)
        masked, reduced = np.empty(image.shape, np.uint8), np.empty((height, width), np.uint8)
        _mask_and_reduce(image, self._is_outside, masked, reduced)
        return masked, reduced


@kernel
def _mask_and_reduce(image, is_outside, masked, reduced):  # type: ignore[no-untyped-def]
    """The picture, 0 outside and at least 1 inside, and the means of four pixels, 0 where one of them is outside."""
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            masked[v, u] = 0 if is_outside[v, u] else max(image[v, u], 1)
    for v in range(reduced.shape[0]):
        for u in range(reduced.shape[1]):
            a, b = np.int32(masked[2 * v, 2 * u]), np.int32(masked[2 * v, 2 * u + 1])
            c, d = np.int32(masked[2 * v + 1, 2 * u]), np.int32(masked[2 * v + 1, 2 * u + 1])
            reduced[v, u] = (a + b + c + d + 2) >> 2 if a > 0 and b > 0 and c > 0 and d > 0 else 0


@inlined
def _centered_patch(image, first, width, side, mask, patch):  # type: ignore[no-untyped-def]
    """Writes the grey levels around a pixel without their mean into `patch`, rows filled up to sixteens; their power."""
    filled, size = mask.shape[0], np.float32(side * side)
    added = splat_f32(np.float32(0.0))
    for x in range(0, filled, WIDE):
        for y in range(side):
            added += load_f32(image, first + y * width + x) * load_f32(mask, x)
    mean, powers = total_f32(added) / size, splat_f32(np.float32(0.0))
    for x in range(0, filled, WIDE):
        for y in range(side):
            centered = (load_f32(image, first + y * width + x) - mean) * load_f32(mask, x)
            store(patch, y * filled + x, centered)
            powers += centered * centered
    return total_f32(powers)


@inlined
def _zncc(patch, power, source, first, width, side, mask, p, q):  # type: ignore[no-untyped-def]
    """ZNCC of a centred patch with the source's, whose first pixel lies (p, q) after `first`; linear between pixels."""
    filled, size, one = mask.shape[0], np.float32(side * side), np.float32(1.0)
    near = np.float32(source[first + (side // 2) * (width + 1)])  # what is subtracted keeps sums of squares small, and exact
    added, powers, products = splat_f32(np.float32(0.0)), splat_f32(np.float32(0.0)), splat_f32(np.float32(0.0))
    for x in range(0, filled, WIDE):
        inside, at = load_f32(mask, x), first + x
        upper = (one - p) * load_f32(source, at) + p * load_f32(source, at + 1)
        for y in range(side):
            at += width
            lower = (one - p) * load_f32(source, at) + p * load_f32(source, at + 1)
            other = ((one - q) * upper + q * lower - near) * inside
            added += other
            powers += other * other
            products += other * load_f32(patch, y * filled + x)
            upper = lower
    summed = total_f32(added)
    return total_f32(products) / np.sqrt(power * (total_f32(powers) - summed * summed / size + np.float32(1e-3)))


@kernel
def _refine(image, sources, motions, camera, pixels, start, step, steps, radius, mask, refined, score):  # type: ignore[no-untyped-def]
    """Inverse depth (N,) where patches agree best: mean ZNCC of the two best sources; NaN where that is at an end or flat.

    `image` and `sources` are flat, with room for sixteen pixels after the last; `camera` fx, fy, cx, cy, width, height.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    width, height, side = int(camera[4]), int(camera[5]), 2 * radius + 1
    patch, scores = np.empty(side * mask.shape[0], np.float32), np.empty(2 * steps + 1, np.float32)
    for n in range(pixels.shape[0]):
        refined[n], score[n] = np.nan, 0.0
        u, v = pixels[n, 0], pixels[n, 1]
        if u < radius or v < radius or u >= width - radius or v >= height - radius:
            continue
        power = _centered_patch(image, (v - radius) * width + u - radius, width, side, mask, patch)
        if power < side * side * MIN_PATCH_DEVIATION**2:
            continue
        for k in range(2 * steps + 1):
            xi = start[n] + (k - steps) * step[n]
            best, second = np.float32(-1.0), np.float32(-1.0)
            for s in range(motions.shape[0]):
                z = 1.0 + xi * motions[s, 2]
                if z <= 0.1:
                    continue
                a = (u - cx + xi * motions[s, 0] * fx) / z + cx
                b = (v - cy + xi * motions[s, 1] * fy) / z + cy
                left, top = int(np.floor(a)), int(np.floor(b))
                if left < radius or top < radius or left >= width - radius - 1 or top >= height - radius - 1:
                    continue
                first = (s * height + top - radius) * width + left - radius
                zncc = _zncc(patch, power, sources, first, width, side, mask, np.float32(a - left), np.float32(b - top))
                second = max(second, min(best, zncc))
                best = max(best, zncc)
            scores[k] = np.float32(0.5) * (best + second)
        k = int(np.argmax(scores))
        if 0 < k < 2 * steps:
            bend = 2.0 * scores[k] - scores[k - 1] - scores[k + 1]
            if bend > 0.0:
                refined[n] = start[n] + (k - steps + 0.5 * (scores[k + 1] - scores[k - 1]) / bend) * step[n]
                score[n] = scores[k]


@kernel
def _look(points, T, center, intrinsics, width, height, cosines):  # type: ignore[no-untyped-def]
    """Fills the cosines (N,) between the rays to the points (N, 3) from here and from -`center`; how many the other camera sees."""
    fx, fy, cx, cy = intrinsics
    num_seen = 0
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a, b, c = x + center[0], y + center[1], z + center[2]
        cosines[n] = (x * a + y * b + z * c) / (np.sqrt(x * x + y * y + z * z) * np.sqrt(a * a + b * b + c * c))
        depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        u = fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth + cx
        v = fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth + cy
        num_seen += depth > 0.0 and 0.0 <= u <= width - 1 and 0.0 <= v <= height - 1
    return num_seen


def _flat(pictures: Array) -> Array:
    """Grey levels one after the other, with room to read sixteen from the last."""
    return np.concatenate([pictures.ravel(), np.zeros(WIDE, pictures.dtype)])


class Densifier:
    """Adds vertices to keyframes of one camera.

    Args:
        camera: of the snapshots' ideal pixels.
        canvas: of the pictures.
    """

    def __init__(self, camera: Camera, canvas: Camera, config: DensificationConfig) -> None:
        self.camera, self.canvas, self.config = camera, canvas, config
        self.reduced = canvas.scaled(1 / REDUCTION).cropped(canvas.width // REDUCTION, canvas.height // REDUCTION)
        self._sweep: PlaneSweep | None = None

    def densify(self, around: Neighbourhood[CanvasPicture]) -> MapSnapshot:
        """The snapshot with more vertices, or as it was where it has few landmarks or too few neighbours with parallax."""
        picture, snapshot = around.item, around.item.snapshot
        if len(snapshot.depths) < self.config.min_landmarks:
            return snapshot
        sources = [*self._chosen(snapshot, around.before), *self._chosen(snapshot, around.after)]
        if len(sources) < 2:
            return snapshot
        T_source_reference = np.stack([s.snapshot.T_cam_world @ inverse(snapshot.T_cam_world) for s in sources])
        rotations, translations = T_source_reference[:, :3, :3], T_source_reference[:, :3, 3]
        motions = np.einsum("nji,nj->ni", rotations, translations)
        small = [turned(s.reduced, self.reduced, R) for s, R in zip(sources, rotations, strict=True)]
        self._sweep = self._sweep or PlaneSweep(self.reduced, self.config)
        planes = self._planes(snapshot)
        swept = self._sweep.depths(picture.reduced, small, motions, planes)
        rows, columns = self._distinct(swept, planes)
        full = np.stack([turned(s.image, self.canvas, R) for s, R in zip(sources, rotations, strict=True)])
        pixels = REDUCTION * np.stack([columns, rows], axis=1).astype(np.int64)
        return self._joined(snapshot, *self._refined(picture, full, motions, pixels, swept.inverse_depth[rows, columns]))

    def _chosen(self, snapshot: MapSnapshot, neighbours: list[CanvasPicture]) -> list[CanvasPicture]:
        """Of the neighbours that see the same place, the ones with the parallaxes asked for."""
        config = self.config
        points = self.camera.rays_from_ideal(snapshot.pixels) * snapshot.depths[:, None]
        seen = [(n, *self._parallax_and_overlap(points, snapshot, n)) for n in neighbours]
        candidates = [(n, parallax) for n, parallax, overlap in seen if overlap >= config.min_overlap and parallax > 0.0]
        chosen = []
        for wanted in (config.near_parallax_deg, config.far_parallax_deg):
            if candidates:
                best = int(np.argmin([abs(np.log(parallax / wanted)) for _, parallax in candidates]))
                chosen.append(candidates.pop(best)[0])
        return chosen

    def _parallax_and_overlap(self, points: Array, snapshot: MapSnapshot, other: CanvasPicture) -> tuple[float, float]:
        """Median angle (degrees) at the points (N, 3) between two cameras, and the share of them that the other sees."""
        T, canvas = np.ascontiguousarray(other.snapshot.T_cam_world @ inverse(snapshot.T_cam_world)), self.canvas
        cosines = np.empty(len(points))
        num_seen = _look(points, T, T[:3, :3].T @ T[:3, 3], canvas.intrinsics, canvas.width, canvas.height, cosines)
        return float(np.degrees(np.arccos(np.clip(np.median(cosines), -1.0, 1.0)))), num_seen / len(points)

    def _planes(self, snapshot: MapSnapshot) -> Array:
        """(D,) inverse depths around those of the landmarks."""
        low, high = np.quantile(1.0 / snapshot.depths, [0.02, 0.98])
        return np.linspace(0.6 * low, 1.3 * high, self.config.planes)

    def _distinct(self, swept: SweptDepth, planes: Array) -> tuple[Array, Array]:
        """Rows and columns (N,) of the most distinct pixel of each cell, where it is distinct, cheap and like its neighbours."""
        config, cell = self.config, self.config.cell_px // REDUCTION
        quality = np.where((swept.inverse_depth > 0) & (swept.cost < config.max_cost), swept.distinctness, 0.0)
        for axis, by in ((0, 2), (0, -2), (1, 2), (1, -2)):
            difference = np.abs(swept.inverse_depth - np.roll(swept.inverse_depth, by, axis))
            quality[difference > 2.0 * (planes[1] - planes[0])] = 0.0
        height, width = (n // cell for n in quality.shape)
        cells = quality[: height * cell, : width * cell].reshape(height, cell, width, cell).transpose(0, 2, 1, 3).reshape(height, width, -1)
        best = cells.argmax(axis=2)
        rows, columns = np.nonzero(cells.max(axis=2) > config.min_distinctness)
        at = best[rows, columns]
        return rows * cell + at // cell, columns * cell + at % cell

    def _refined(
        self, picture: CanvasPicture, sources: Array, motions: Array, pixels: Array, inverse_depths: Array
    ) -> tuple[Array, Array, Array]:
        """Canvas pixels (N, 2), inverse depths (N,) and relative deviations (N,) of those whose patches agree."""
        config = self.config
        rates = self._pixels_per_relative_depth(pixels, inverse_depths, motions)
        step = REFINEMENT_STEP_PX * inverse_depths / np.maximum(rates.max(axis=1), 1e-3)
        refined, score = np.empty(len(pixels)), np.empty(len(pixels))
        radius = config.patch_px // 2
        filled = -(-(2 * radius + 1) // WIDE) * WIDE
        mask = (np.arange(filled) <= 2 * radius).astype(np.float32)
        camera = np.array([*self.canvas.intrinsics, self.canvas.width, self.canvas.height])
        _refine(
            _flat(picture.image), _flat(sources), motions, camera, pixels, inverse_depths, step,
            REFINEMENT_STEPS, radius, mask, refined, score,
        )  # fmt: skip
        deviations = config.sigma_px / np.maximum(np.sqrt((np.sort(rates, axis=1)[:, -3:] ** 2).sum(axis=1)), 1e-3)
        good = np.isfinite(refined) & (refined > 0) & (score > config.min_zncc) & (deviations < config.max_relative_deviation)
        return pixels[good].astype(np.float64), refined[good], deviations[good]

    def _pixels_per_relative_depth(self, pixels: Array, inverse_depths: Array, motions: Array) -> Array:
        """(N, S) by how many pixels a point moves in each source when its inverse depth grows by its own size."""
        x, y, _ = self.canvas.rays_from_ideal(pixels).T
        fx, fy = self.canvas.intrinsics[:2]
        u = fx * (motions[None, :, 0] - x[:, None] * motions[None, :, 2])
        v = fy * (motions[None, :, 1] - y[:, None] * motions[None, :, 2])
        return np.asarray(inverse_depths[:, None] * np.hypot(u, v) / (1.0 + inverse_depths[:, None] * motions[None, :, 2]) ** 2)

    def _joined(self, snapshot: MapSnapshot, pixels: Array, inverse_depths: Array, deviations: Array) -> MapSnapshot:
        return replace(
            snapshot,
            pixels=np.concatenate([snapshot.pixels, self.canvas.ideal_in(self.camera, pixels)]),
            depths=np.concatenate([snapshot.depths, 1.0 / inverse_depths]),
            relative_deviations=np.concatenate([snapshot.relative_deviations, deviations]),
        )
