# SPDX-License-Identifier: Apache-2.0
"""The solvers by name; all of them minimise the same objective with the same derivatives (`geometry/reprojection.py`)."""

from collections.abc import Callable

from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.bundle_adjustment.schur import adjust_schur
from vitamin3d.bundle_adjustment.subspace import adjust_subspace
from vitamin3d.config import BundleAdjustmentConfig
from vitamin3d.geometry.camera import Camera
from vitamin3d.types import BundleReport

SOLVERS: dict[str, Callable[[BundleProblem, Camera, float, int, float], tuple[BundleProblem, BundleReport]]] = {
    "subspace": adjust_subspace,
    "schur": adjust_schur,
}
"""Each takes the problem, the camera, sigma_px, the most iterations, and the relative gain that ends them."""


def adjust_bundle(problem: BundleProblem, camera: Camera, config: BundleAdjustmentConfig) -> tuple[BundleProblem, BundleReport]:
    """The window's adjustment at a keyframe, by the solver that the settings name."""
    solver = SOLVERS[config.keyframe_solver]
    return solver(problem, camera, config.sigma_px, config.keyframe_iterations, config.relative_gain)
