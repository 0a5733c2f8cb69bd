# SPDX-License-Identifier: Apache-2.0
"""Least-squares similarity between two point sets (Umeyama 1991)."""

import numpy as np

from vitamin3d.errors import InputError
from vitamin3d.types import Array


def align_sim3(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale s, rotation R (3, 3) and translation t (3,) with `target ~ s R source + t`.

    Args:
        source: (N, 3) points.
        target: (N, 3) points, paired by row.

    Raises:
        InputError: fewer than three pairs, or all of `source` in one place.
    """
    if len(source) < 3 or len(source) != len(target):
        raise InputError(f"an alignment needs at least three pairs of positions, not {min(len(source), len(target))}")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_centred, target_centred = source - source_mean, target - target_mean
    variance = float((source_centred**2).sum() / len(source))
    if variance < 1e-24:
        raise InputError("an alignment needs a trajectory that moves: all positions are the same")
    U, D, Vt = np.linalg.svd(target_centred.T @ source_centred / len(source))
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ S @ Vt
    s = float(np.trace(np.diag(D) @ S) / variance)
    return s, R, target_mean - s * R @ source_mean
