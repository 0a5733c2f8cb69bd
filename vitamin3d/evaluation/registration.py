# SPDX-License-Identifier: Apache-2.0
"""Puts one cloud onto another of unknown scale and frame, when no trajectory says how.

Neither cloud is complete and their scales may differ by anything, so that moments and features mislead. Instead: the clouds are
brought to one size by robust statistics, many rotations and some scales are tried by a few rounds of trimmed ICP on a few
hundred points, and the best are refined on all. The score is symmetric (a shrunken cloud would fit anywhere one way).
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vitamin3d.errors import InputError
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.types import Array

COARSE_POINTS, FINE_POINTS = 400, 5000
NUM_ROTATIONS, SCALES = 120, (0.5, 0.63, 0.79, 1.0, 1.26, 1.59, 2.0)
COARSE_ROUNDS, FINE_ROUNDS, FINALISTS = 6, 40, 24
KEPT = 0.6
"""Share of the pairs, the nearest, that each round of ICP fits: the clouds overlap only in part."""
LEAST_OVERLAP, REACH, MOST_DISTANCE = 0.7, 0.04, 0.013
"""A registration holds where this share of both clouds has a neighbour within REACH of the size, and the kept pairs are nearer than
MOST_DISTANCE of it in the median: true pairs of sparse clouds reach 0.7 to 1.1 percent, false ones 1.6 to 2.1."""
TIGHTEST, TIGHT_ROUNDS = 0.006, 40
LEAST_POINTS = 20


@dataclass(frozen=True)
class Registration:
    """A similarity and how well it holds."""

    scale: float
    R: Array
    t: Array
    median_distance: float
    """Of the kept pairs, both ways, in the target's unit."""
    overlap: float
    """Smaller of the two shares of points with a neighbour in the other cloud."""
    size: float
    """Of the target, in its unit."""

    @property
    def holds(self) -> bool:
        return self.overlap >= LEAST_OVERLAP and self.median_distance <= MOST_DISTANCE * self.size

    def apply(self, points: Array) -> Array:
        """Points (N, 3) of the source in the target's frame and unit."""
        return np.asarray(self.scale * points @ self.R.T + self.t)


def register(source: Array, target: Array, seed: int = 0) -> Registration:
    """The similarity that puts the source (N, 3) onto the target (M, 3); deterministic.

    Raises:
        InputError: too few points.
    """
    if min(len(source), len(target)) < LEAST_POINTS:
        raise InputError(f"a registration needs at least {LEAST_POINTS} points in both clouds, not {min(len(source), len(target))}")
    rng = np.random.default_rng(seed)
    size = _size(target)
    ratio = size / max(_size(source), 1e-12)
    some, others = _Sample.of(source, COARSE_POINTS, rng), _Sample.of(target, COARSE_POINTS, rng)
    starts = product(Rotation.random(NUM_ROTATIONS, rng=rng).as_matrix(), SCALES)
    coarse = [_icp(some, others, (s * ratio, R, _middle(target) - s * ratio * R @ _middle(source)), COARSE_ROUNDS) for R, s in starts]
    best = sorted(coarse, key=lambda c: _score(some, others, c, size))[:FINALISTS]
    middle, goal = _Sample.of(source, 4 * COARSE_POINTS, rng), _Sample.of(target, 4 * COARSE_POINTS, rng)
    better = sorted((_icp(middle, goal, c, 2 * COARSE_ROUNDS) for c in best), key=lambda c: _score(middle, goal, c, size))[:4]
    fine, ends = _Sample.of(source, FINE_POINTS, rng), _Sample.of(target, FINE_POINTS, rng)
    fitted = min((_icp(fine, ends, c, FINE_ROUNDS) for c in better), key=lambda c: _score(fine, ends, c, size))
    return _judged(source, target, *_tightened(source, target, fitted, size), size)


Similarity = tuple[float, Array, Array]


@dataclass(frozen=True)
class _Sample:
    """Some points of a cloud and the tree that finds the nearest of them."""

    points: Array
    tree: cKDTree

    @staticmethod
    def of(points: Array, count: int, rng: np.random.Generator) -> "_Sample":
        some = points if len(points) <= count else points[rng.choice(len(points), count, replace=False)]
        return _Sample(some, cKDTree(some))


def _pairs(source: _Sample, target: _Sample, similarity: Similarity) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Distances in the target's unit, and indices, from the source to the target and back; each tree stays where it is."""
    s, R, t = similarity
    back, i = source.tree.query((target.points - t) @ R / s)
    return target.tree.query(s * source.points @ R.T + t), (s * back, i)


def _icp(source: _Sample, target: _Sample, start: Similarity, rounds: int) -> Similarity:
    """Trimmed point-to-point ICP with scale, pairs from both sides."""
    s, R, t = start
    for _ in range(rounds):
        (there, j), (back, i) = _pairs(source, target, (s, R, t))
        kept_there, kept_back = (d <= np.quantile(d, KEPT) for d in (there, back))
        a = np.concatenate([source.points[kept_there], source.points[i[kept_back]]])
        b = np.concatenate([target.points[j[kept_there]], target.points[kept_back]])
        if len(a) < 3 or np.ptp(a, axis=0).max() < 1e-12:
            break
        s, R, t = align_sim3(a, b)
    return s, R, t


def _tightened(source: Array, target: Array, start: Similarity, size: float) -> Similarity:
    """ICP with pairs nearer and nearer: what one cloud has and the other has not no longer pulls."""
    tree, (s, R, t) = cKDTree(target), start
    some = source[:: max(1, len(source) // (4 * FINE_POINTS))]
    for reach in np.geomspace(REACH, TIGHTEST, TIGHT_ROUNDS) * size:
        distance, j = tree.query(s * some @ R.T + t, distance_upper_bound=reach)
        good = np.isfinite(distance)
        if good.sum() < LEAST_POINTS:
            break
        s, R, t = align_sim3(some[good], target[j[good]])
    return s, R, t


def _score(source: _Sample, target: _Sample, similarity: Similarity, size: float) -> float:
    """Mean of bounded distances both ways, relative to the size: small is good."""
    both = [np.minimum(distance, 0.1 * size).mean() for distance, _ in _pairs(source, target, similarity)]
    return float(max(both) / size)


def _judged(source: Array, target: Array, s: float, R: Array, t: Array, size: float) -> Registration:
    placed = s * source @ R.T + t
    distances = [cKDTree(b).query(a)[0] for a, b in ((placed, target), (target, placed))]
    kept = np.concatenate([d[d <= np.quantile(d, KEPT)] for d in distances])
    overlap = min(float((d < REACH * size).mean()) for d in distances)
    return Registration(s, R, t, float(np.median(kept)), overlap, size)


def _middle(points: Array) -> Array:
    return np.asarray(np.median(points, axis=0))


def _size(points: Array) -> float:
    """Twice the 80th percentile of the distances to the middle."""
    return 2.0 * float(np.percentile(np.linalg.norm(points - _middle(points), axis=1), 80))
