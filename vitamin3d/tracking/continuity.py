# SPDX-License-Identifier: Apache-2.0
"""Which earlier picture a picture continues, and the flow from it: a cut, a stray picture or a covered lens must not pull the tracks along.

Extrema are everywhere: after a jump of the picture tracks climb to others nearby and agree on a camera that stands still. But the
picture before, moved by the flow, then looks unlike this one on a coarse grid, where neither blur nor noise nor exposure matter.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from vitamin3d.config import ContinuityConfig
from vitamin3d.image.corners import described_corners, mutual_matches
from vitamin3d.types import Array

LEAST_SHARED = 0.1
"""Of a picture, that must be in the other one too to be compared."""
LARGEST_DIFFERENCE = 20
"""Grey levels: what is hidden in one of the pictures says no more than that."""
HOMOGRAPHY_PX, HOMOGRAPHY_ITERATIONS = 6.0, 500


@dataclass(frozen=True)
class View:
    """A picture as the next ones are compared with it."""

    index: int
    picture: Array
    """(h, w) uint8, reduced."""
    grid: Array
    """(h / reduction, w / reduction) float32."""
    num_corners: int

    @cached_property
    def corners(self) -> tuple[Array, Array]:
        """Described corners of the picture, from `described_corners`."""
        return described_corners(self.picture, self.num_corners)

    @property
    def contrast(self) -> float:
        """Standard deviation on the grid, grey levels."""
        return float(self.grid.std())


@dataclass(frozen=True)
class Continuation:
    """A flow and how well it explains the picture."""

    flow: Array
    """(h, w, 2) float32, pixels of the reduced picture."""
    correlation: float
    """Of the two grids where the flow stays in the picture, in [-1, 1]."""


def view_of(index: int, picture: Array, config: ContinuityConfig) -> View:
    """A reduced picture (h, w) uint8 with its coarse grid."""
    size = max(1, picture.shape[1] // config.reduction), max(1, picture.shape[0] // config.reduction)
    return View(index, picture, cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32), config.corners)


def _moved_back(b: Array, flow: Array) -> tuple[Array, Array]:
    """A picture (h, w) moved back by a flow (h, w, 2) that leads to it, and where (h, w) bool that stays inside."""
    height, width = b.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    u, v = u + flow[..., 0], v + flow[..., 1]
    inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    return cv2.remap(b, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), inside


def correlation(a: Array, b: Array, flow: Array) -> float:
    """Zero-mean normalised cross-correlation of grid a (h, w) with grid b moved back by a flow (H, W, 2), where both are there; else 0."""
    height, width = a.shape
    coarse = cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) * np.float32(width / flow.shape[1])
    moved, inside = _moved_back(b, coarse)
    if inside.sum() < LEAST_SHARED * a.size:
        return 0.0
    x, y = a[inside] - a[inside].mean(), moved[inside] - moved[inside].mean()
    return float((x * y).sum() / np.sqrt(max(1e-6, float((x * x).sum()) * float((y * y).sum()))))


def homography_flow(a: View, b: View, config: ContinuityConfig) -> Array | None:
    """Flow (h, w, 2) float32 by the homography of matched corners of two pictures (h, w); None where few agree on one."""
    (points_a, words_a), (points_b, words_b) = a.corners, b.corners
    pairs = mutual_matches(words_a, words_b)
    if len(pairs) < config.min_matches:
        return None
    x, y = points_a[pairs[:, 0]], points_b[pairs[:, 1]]
    H, agrees = cv2.findHomography(x, y, cv2.RANSAC, HOMOGRAPHY_PX, maxIters=HOMOGRAPHY_ITERATIONS)
    if H is None or agrees.sum() < config.min_matches:
        return None
    flow = _flow_of_homography(H, *a.picture.shape)
    return flow if np.isfinite(flow).all() and np.abs(flow).max() < 2 * a.picture.shape[1] else None


def _flow_of_homography(H: Array, height: int, width: int) -> Array:
    """(h, w, 2) float32: where a homography (3, 3) moves each pixel."""
    u, v = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]
    x, y, z = (row[0] * u + (row[1] * v + row[2]) for row in H)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([x / z - u, y / z - v], axis=-1).astype(np.float32)


def step_of(flow: Array) -> float:
    """Median length of a flow (h, w, 2), in sizes of the picture: square roots of its area."""
    return float(np.median(np.hypot(*flow[::8, ::8].T)) / np.sqrt(flow.shape[0] * flow.shape[1]))


def residual(a: Array, b: Array, flow: Array) -> float:
    """Mean difference, grey levels, of a picture (h, w) uint8 from another, moved back by a flow (h, w, 2), where both are there."""
    moved, inside = _moved_back(b, flow)
    if inside.sum() < LEAST_SHARED * a.size:
        return float("inf")
    return float(np.minimum(cv2.absdiff(a, moved)[inside], LARGEST_DIFFERENCE).mean())


class FlowTracker:
    """The flow to each picture from the one it continues; remembers the previous picture, and the last one before a break."""

    def __init__(self, dis: cv2.DISOpticalFlow, dis_from: cv2.DISOpticalFlow, config: ContinuityConfig) -> None:
        self._dis, self._dis_from, self.config = dis, dis_from, config
        self._previous: View | None = None
        self._before_break: View | None = None
        self.is_exact = True
        """Whether the newest flow explains its picture well; where it does not, the step was large."""

    def follow(self, index: int, picture: Array) -> tuple[Array | None, int | None]:
        """The flow (h, w, 2) from the picture that a reduced picture (h, w) uint8 continues, and that one's index; None for none."""
        view = view_of(index, picture, self.config)
        previous, self._previous, self.is_exact = self._previous, view, True
        if previous is None:
            return None, None
        if not self.config.enabled:
            return self._flow(previous, view), previous.index
        return self._continued(previous, view)

    def _continued(self, previous: View, view: View) -> tuple[Array | None, int | None]:
        earlier = self._before_break
        for candidate in (previous, earlier):
            found = None if candidate is None else self._continuation(candidate, view)
            if candidate is not None and found is not None and found.correlation >= self.config.min_correlation:
                self._forget_break(candidate, view.index)
                self.is_exact = found.correlation >= self.config.good_correlation
                return found.flow, candidate.index
        if earlier is None or earlier.contrast < self.config.min_contrast or view.index - earlier.index > self.config.max_gap:
            self._before_break = previous
        return None, None

    def _forget_break(self, followed: View, index: int) -> None:
        """The picture before a break is given up once it is followed, or too old."""
        earlier = self._before_break
        if earlier is not None and (followed is earlier or index - earlier.index > self.config.max_gap):
            self._before_break = None

    def _continuation(self, a: View, b: View) -> Continuation | None:
        """The better one of the plain flow and the one that begins with a homography; None where one of the pictures shows nothing."""
        if min(a.contrast, b.contrast) < self.config.min_contrast:
            return None
        flow = self._flow(a, b)
        plain = Continuation(flow, correlation(a.grid, b.grid, flow))
        is_explained, step = plain.correlation >= self.config.good_correlation, step_of(flow)
        start = None if is_explained and step <= self.config.large_step else homography_flow(a, b, self.config)
        if start is None:
            return plain if step <= self.config.largest_step else None
        flow = np.asarray((self._dis if is_explained else self._dis_from).calc(a.picture, b.picture, start))
        again = Continuation(flow, correlation(a.grid, b.grid, flow))
        if not is_explained:  # the exposure may differ
            return max(plain, again, key=lambda found: found.correlation)
        return min(plain, again, key=lambda found: residual(a.picture, b.picture, found.flow))

    def _flow(self, a: View, b: View) -> Array:
        return np.asarray(self._dis.calc(a.picture, b.picture, None))
