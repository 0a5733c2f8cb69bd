# SPDX-License-Identifier: Apache-2.0
"""Ceres by way of pycolmap, as the reference solver of `benchmark_bundle_adjustment.py` (an extra: `pip install pycolmap`)."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem
from vitamin3d.types import Array

PICTURE_PX = 100_000
"""The size of the picture, which has no part in an adjustment."""


@dataclass(frozen=True)
class CeresRun:
    """One adjustment by Ceres."""

    cost: float
    """Half the sum of the losses at the end."""
    seconds: float
    """Of the CPU, of its preprocessor and minimiser; what Python takes to hand the problem over is not counted."""
    iterations: int
    models: Array
    """(1, 8) or (C, 8) afterwards."""


def solve_with_ceres(
    problem: BundleProblem, models: Array, cauchy_px: float = 0.0, iterations: int = 100, tolerance: float = 1e-7
) -> CeresRun:
    """Levenberg–Marquardt of Ceres with the linear solver that pycolmap picks by size, one thread; f k1 k2 free.

    Args:
        models: (1, 8) of all cameras or (C, 8); their radial part is used.
        cauchy_px: scale of the Cauchy loss; 0: least squares.
    """
    import pycolmap  # type: ignore[import-not-found,unused-ignore]

    scene = _reconstruction(pycolmap, problem, models)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    if cauchy_px:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = cauchy_px
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 1, iterations, tolerance
    solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for image in scene.images:
        config.add_image(image)
    for c in np.flatnonzero(~problem.camera_is_free):
        config.set_constant_rig_from_world_pose(int(c) + 1)
        if len(models) > 1:
            config.set_constant_cam_intrinsics(int(c) + 1)
    adjuster: Any = pycolmap.create_default_bundle_adjuster(options, config, scene)
    start = time.process_time()
    summary = adjuster.solve().ceres_summary
    seconds = min(time.process_time() - start, summary.total_time_in_seconds)
    steps = summary.num_successful_steps + summary.num_unsuccessful_steps
    return CeresRun(summary.final_cost, seconds, steps, _models_of(scene, models))


def _reconstruction(pycolmap: Any, problem: BundleProblem, models: Array) -> Any:
    scene = pycolmap.Reconstruction()
    for c, model in enumerate(models, 1):
        params = [model[0], model[2], model[3], model[4], model[5]]
        camera = pycolmap.Camera(camera_id=c, model="RADIAL", width=PICTURE_PX, height=PICTURE_PX, params=params)
        scene.add_camera_with_trivial_rig(camera)
    tracks: list[Any] = [pycolmap.Track() for _ in problem.points_world]
    starts = np.searchsorted(problem.obs_camera, np.arange(len(problem.T_cam_world) + 1))
    for c, T in enumerate(problem.T_cam_world):
        rows = slice(starts[c], starts[c + 1])
        image = pycolmap.Image(name=str(c), keypoints=problem.obs_pixels[rows], camera_id=min(c + 1, len(models)), image_id=c + 1)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T[:3]))
        for k, p in enumerate(problem.obs_point[rows]):
            tracks[p].add_element(c + 1, k)
    for X, track in zip(problem.points_world, tracks, strict=True):
        if track.length() >= 2:
            scene.add_point3D(X, track)
    return scene


def _models_of(scene: Any, models: Array) -> Array:
    out = np.array(models)
    for c in range(len(models)):
        f, _, _, k1, k2 = scene.cameras[c + 1].params
        out[c, 1] *= f / out[c, 0]
        out[c, 0], out[c, 4], out[c, 5] = f, k1, k2
    return out
