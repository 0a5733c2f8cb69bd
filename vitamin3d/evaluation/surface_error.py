# SPDX-License-Identifier: Apache-2.0
"""How far a cloud or a mesh is from the true surface, and how much of that it covers.

Two protocols. *Shares* (as multi-view stereo is scored): median distance to the truth, and the share of the truth within 5
and 10 cm. *RMSE* (MASt3R-SLAM, CVPR 2025, Table 3): accuracy = RMSE of the distances from estimated points to the reference,
completion = RMSE of those from the reference to the estimate, both cut off at half a metre, chamfer = their mean; against
the part of the reference that keyframes observed.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vitamin3d.datasets.point_files import Geometry
from vitamin3d.errors import InputError
from vitamin3d.geometry.sim3_alignment import align_sim3
from vitamin3d.types import Array

SAMPLES = 500_000
"""Points that stand for a mesh."""
OBSERVED = 0.30
"""Metres: an estimated point farther from all truth lies where nobody knows the truth."""
CUT_OFF = 0.50
"""Metres: MASt3R-SLAM's largest distance."""
FARTHEST = 1.0
"""Metres: completion counts no distance beyond."""
ICP_REACH, ICP_MOTION, ICP_SCALE, ICP_ROUNDS, ICP_POINTS, ICP_LEAST = 0.10, 0.25, 0.01, 8, 40_000, 1000
"""The refinement after the alignment by trajectories: pairs within 10 cm, no point moved by more than 25 cm per round, the scale
by no more than one percent, eight rounds on at most 40,000 points."""


@dataclass(frozen=True)
class SurfaceErrors:
    """All figures of both protocols; lengths in metres, NaN where nothing was observed."""

    accuracy_median: float
    accuracy_mean: float
    accuracy_rmse: float
    accuracy_within_5cm: float
    """Share of the estimated points that the truth observed."""
    unobserved: float
    """Share of the estimated points more than 30 cm from all truth; left out of the accuracy."""
    completeness_5cm: float
    completeness_10cm: float
    """Shares of the truth that have an estimated point within 5 and 10 cm."""
    completion_mean: float
    chamfer: float
    """Mean of the mean accuracy and the mean completion."""
    rmse_accuracy: float
    rmse_completion: float
    rmse_chamfer: float
    """MASt3R-SLAM's protocol."""


def sample_surface(geometry: Geometry, count: int = SAMPLES, seed: int = 0) -> Array:
    """Points (N, 3) that stand for it: those of a cloud; of a mesh, `count` independent ones by area, as Open3D draws them.

    Points spread more evenly than that would leave fewer gaps and so a completion 3 % smaller than that of the usual scripts.
    """
    if not geometry.is_mesh:
        return geometry.points
    if not surface_area(geometry) > 0:
        raise InputError("a mesh without area; export it again")
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(geometry.points), o3d.utility.Vector3iVector(geometry.triangles.astype(np.int32))
    )
    o3d.utility.random.seed(seed)
    return np.array(mesh.sample_points_uniformly(count).points)


def surface_area(geometry: Geometry) -> float:
    """Area of a mesh; NaN for a cloud."""
    if not geometry.is_mesh:
        return float("nan")
    a, b, c = (geometry.points[geometry.triangles[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def nearest(points: Array, others: Array, at_most: float = np.inf) -> Array:
    """Distances (N,) from each point to the nearest of the others; infinite beyond `at_most`, which is faster."""
    return np.asarray(cKDTree(others).query(points, distance_upper_bound=at_most)[0])


def surface_errors(points: Array, truth: Array) -> SurfaceErrors:
    """All figures of estimated points (N, 3) against points (M, 3) of the true surface, both in metres and in one world."""
    to_truth, to_estimate = nearest(points, truth, CUT_OFF), nearest(truth, points, FARTHEST)
    seen = to_truth[to_truth < OBSERVED]
    seen = seen if len(seen) else np.array([np.nan])
    completion = np.minimum(to_estimate, FARTHEST).mean()
    near, covered = (d[d < CUT_OFF] for d in (to_truth, to_estimate))
    rmse_accuracy, rmse_completion = (float(np.sqrt((d**2).mean())) if len(d) else float("nan") for d in (near, covered))
    return SurfaceErrors(
        float(np.median(seen)),
        float(seen.mean()),
        float(np.sqrt((seen**2).mean())),
        float((seen < 0.05).mean()),
        float((to_truth >= OBSERVED).mean()),
        float((to_estimate < 0.05).mean()),
        float((to_estimate < 0.10).mean()),
        float(completion),
        float((seen.mean() + completion) / 2),
        rmse_accuracy,
        rmse_completion,
        (rmse_accuracy + rmse_completion) / 2,
    )


def refined(points: Array, truth: Array) -> tuple[Array, tuple[float, Array, Array]]:
    """Points (N, 3) after a scale-aware ICP of small motions: a scale error of half a percent is no error of the surface.

    Returns:
        The points, and the scale, rotation (3, 3) and translation (3,) that were applied.
    """
    tree, moved = cKDTree(truth), points
    total: tuple[float, Array, Array] = (1.0, np.eye(3), np.zeros(3))
    for _ in range(ICP_ROUNDS):
        some = moved[:: max(1, len(moved) // ICP_POINTS)]
        distance, index = tree.query(some, distance_upper_bound=ICP_REACH)
        good = np.isfinite(distance)
        if good.sum() < min(ICP_LEAST, 0.5 * len(some)):
            break
        s, R, t = align_sim3(some[good], truth[index[good]])
        s = float(np.clip(s, 1 - ICP_SCALE, 1 + ICP_SCALE))
        after = s * moved @ R.T + t
        if np.abs(after - moved).max() > ICP_MOTION:
            break
        moved, total = after, (s * total[0], R @ total[1], s * R @ total[2] + t)
    return moved, total
