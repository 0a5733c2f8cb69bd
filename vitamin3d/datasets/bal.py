# SPDX-License-Identifier: Apache-2.0
"""Problems of "Bundle Adjustment in the Large" (Agarwal et al., ECCV 2010), `.txt` or `.txt.bz2`.

A BAL camera looks along its -z axis, has a focal length and two radial coefficients of its own, and its picture's y
axis points up. Turned by half a circle about x, it is our camera with fx = fy, cx = cy = 0 and p1 = p2 = 0.
"""

import bz2
from pathlib import Path

import numpy as np

from vitamin3d.bundle_adjustment.problem import BundleProblem, make_problem
from vitamin3d.errors import InputError
from vitamin3d.geometry.se3 import exp_so3
from vitamin3d.types import Array

CAMERA_SIZE = 9
FLIP = np.diag([1.0, -1.0, -1.0])


def read_bal(path: Path) -> tuple[BundleProblem, Array]:
    """The problem, its first camera fixed, and the camera models (C, 8) fx fy cx cy k1 k2 p1 p2.

    Raises:
        InputError: no such file, or not a BAL problem.
    """
    try:
        data = path.read_bytes()
        words = (bz2.decompress(data) if path.suffix == ".bz2" else data).split()
        counts = [int(word) for word in words[:3]]
        values = np.array(words[3:], np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} is no BAL problem ({error}); expected text that starts with three counts, plain or .bz2") from None
    if len(counts) < 3 or len(values) != 4 * counts[2] + CAMERA_SIZE * counts[0] + 3 * counts[1]:
        raise InputError(f"{path} is cut short or no BAL problem: its three counts do not match its {len(values)} numbers")
    num_cameras, num_points, num_observations = counts
    rows = values[: 4 * num_observations].reshape(-1, 4)
    cameras = values[4 * num_observations : 4 * num_observations + CAMERA_SIZE * num_cameras].reshape(-1, CAMERA_SIZE)
    points = values[4 * num_observations + CAMERA_SIZE * num_cameras :].reshape(-1, 3)
    poses = np.tile(np.eye(4), (num_cameras, 1, 1))
    poses[:, :3, :3] = FLIP @ np.array([exp_so3(camera[:3]) for camera in cameras])
    poses[:, :3, 3] = cameras[:, 3:6] @ FLIP
    models = np.zeros((num_cameras, 8))
    models[:, :2], models[:, 4:6] = cameras[:, 6:7], cameras[:, 7:9]
    camera, point = rows[:, 0].astype(np.int32), rows[:, 1].astype(np.int32)
    if (
        camera.min(initial=0) < 0
        or point.min(initial=0) < 0
        or camera.max(initial=-1) >= num_cameras
        or point.max(initial=-1) >= num_points
    ):
        raise InputError(f"{path}: an observation names a camera or a point that is not there")
    return make_problem(poses, points, camera, point, rows[:, 2:] * [1.0, -1.0]), models
