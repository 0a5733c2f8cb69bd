# SPDX-License-Identifier: Apache-2.0
"""How dense a cloud is and what it covers, alone and beside another: no truth is needed."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vitamin3d.datasets.point_files import Geometry
from vitamin3d.evaluation.reference_surface import voxel_keys
from vitamin3d.evaluation.surface_error import nearest, surface_area
from vitamin3d.types import Array

VOXELS = (0.02, 0.05, 0.10)
NEIGHBOURS = 8
COVERED = 0.05
"""A place is covered where a point lies within this, metres."""


@dataclass(frozen=True)
class Density:
    """Figures of one cloud or mesh; lengths in the unit of its points."""

    points: int
    points_per_m2: float
    """Of a cloud: the median over its points of the density on the surface around each; of a mesh: vertices per area."""
    area_m2: float
    """Of a mesh; NaN for a cloud."""
    voxels: dict[str, int]
    """Side in centimetres -> number of voxels with a point, a mesh being sampled."""


def density(geometry: Geometry, samples: Array) -> Density:
    """The figures of a geometry and the points (N, 3) that stand for it."""
    area = surface_area(geometry)
    per_m2 = len(geometry.points) / area if geometry.is_mesh else points_per_area(geometry.points)
    voxels = {f"{100 * side:g}": len(np.unique(voxel_keys(samples, side))) for side in VOXELS}
    return Density(len(geometry.points), per_m2, area, voxels)


def points_per_area(points: Array) -> float:
    """Median density on the surface: `NEIGHBOURS` others in the disc that reaches to the last of them; NaN for a few points."""
    if len(points) <= NEIGHBOURS:
        return float("nan")
    radius = cKDTree(points).query(points, k=NEIGHBOURS + 1)[0][:, -1]
    return float(np.median(NEIGHBOURS / (np.pi * np.maximum(radius, 1e-12) ** 2)))


@dataclass(frozen=True)
class Mutual:
    """One cloud beside another where nobody knows the truth; lengths in their unit."""

    its_median: float
    """Distance from its points to ours."""
    its_within_5cm: float
    ours_median: float
    """Distance from our points to its."""
    ours_within_5cm: float


def mutual(its: Array, ours: Array) -> Mutual:
    """Distances both ways between two clouds of points in one world."""
    there, back = nearest(its, ours), nearest(ours, its)
    return Mutual(float(np.median(there)), float((there < COVERED).mean()), float(np.median(back)), float((back < COVERED).mean()))


@dataclass(frozen=True)
class Coverage:
    """Shares of the places that one covers and the other does not, and that both do."""

    of: str
    """`truth`: of the true surface; `voxels`: of all 10 cm voxels that either occupies."""
    both: float
    ours_only: float
    its_only: float


def coverage_of_truth(its: Array, ours: Array, truth: Array) -> Coverage:
    """Which of the true points (M, 3) have a point of theirs, and of ours, within 5 cm."""
    a, b = (nearest(truth, points, COVERED) < COVERED for points in (its, ours))
    return Coverage("truth", float((a & b).mean()), float((b & ~a).mean()), float((a & ~b).mean()))


def coverage_of_voxels(its: Array, ours: Array, side: float = VOXELS[-1]) -> Coverage:
    """Which of the voxels that either occupies has a point of the other within one side."""
    cells = [_centres(points, side) for points in (its, ours)]
    lone = [nearest(cells[k], points, 2.0 * side) > 1.5 * side for k, points in ((0, ours), (1, its))]
    its_only, ours_only = (int(missing.sum()) for missing in lone)
    both = max(len(cells[0]) - its_only, len(cells[1]) - ours_only)
    total = max(1, its_only + ours_only + both)
    return Coverage("voxels", both / total, ours_only / total, its_only / total)


def _centres(points: Array, side: float) -> Array:
    return np.unique(np.floor(points / side), axis=0) * side + side / 2
