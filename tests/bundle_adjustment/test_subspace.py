# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference
from scenes import PINHOLE, three_cameras

from vitamin3d.bundle_adjustment import subspace
from vitamin3d.bundle_adjustment.adjust import SOLVERS
from vitamin3d.bundle_adjustment.subspace import adjust_subspace, new_scratch, sweep_cameras, sweep_points
from vitamin3d.bundle_adjustment.variables import (
    Variables,
    free_slots,
    pinhole_model,
    sightings_of,
)

SIGMA = 2.0


def test_one_subspace_sweep_equals_dense_blocks():
    """Eq. 11 for the cameras, each by its own 6×6 block, and then Eq. 12 at the moved cameras."""
    problem = three_cameras(1)
    H, g = reference.full_normal_equations(problem, PINHOLE.intrinsics, SIGMA)
    poses = problem.T_cam_world.copy()
    for n, c in enumerate(np.flatnonzero(problem.camera_is_free)):
        block = slice(6 * n, 6 * n + 6)
        poses[c] = reference.exp_se3(-np.linalg.solve(H[block, block], g[block])) @ poses[c]
    moved = dataclasses.replace(problem, T_cam_world=poses)
    H, g = reference.full_normal_equations(moved, PINHOLE.intrinsics, SIGMA)
    points = problem.points_world.copy()
    for p in range(1, len(points)):
        block = slice(12 + 3 * p, 15 + 3 * p)
        points[p] -= np.linalg.solve(H[block, block], g[block])
    moved = dataclasses.replace(moved, points_world=points)
    solved, report = adjust_subspace(problem, PINHOLE, SIGMA, 1)
    assert reference.robust_cost(moved, PINHOLE.intrinsics, SIGMA) == pytest.approx(report.costs[1], rel=1e-6)
    np.testing.assert_allclose(solved.T_cam_world, poses, atol=1e-7)
    np.testing.assert_allclose(solved.points_world, points, atol=1e-6)


@pytest.mark.parametrize("sweeps", [1, 3, 3000])
def test_inner_sweeps_solve_the_full_equations_block_by_block(sweeps, monkeypatch):
    """Cameras by their 6×6 blocks, then points by their 3×3 ones, with the derivatives of the start; in the end H dx = -g."""
    problem = three_cameras(2)
    H, g = reference.full_normal_equations(problem, PINHOLE.intrinsics, SIGMA)
    used = np.diag(H) > 0  # not the point that is seen once
    x, blocks = np.zeros(len(g)), [slice(k, k + 6) for k in range(0, 6, 6)] + [slice(k, k + 3) for k in range(6, len(g), 3)]
    for _ in range(min(sweeps, 3)):
        for block in (b for b in blocks if used[b].all()):
            x[block] -= np.linalg.solve(H[block, block], g[block] + H[block] @ x)
    if sweeps > 3:
        x[used] = -np.linalg.solve(H[np.ix_(used, used)], g[used])
    monkeypatch.setattr(subspace, "INNER_SWEEPS", sweeps)
    solved, _ = SOLVERS["subspace-inner"](problem, PINHOLE, SIGMA, 1, 0.0)
    size = np.abs(x).max()
    np.testing.assert_allclose(solved.points_world - problem.points_world, x[6:].reshape(-1, 3), atol=1e-5 * size)
    np.testing.assert_allclose(solved.T_cam_world[2], reference.exp_se3(x[:6]) @ problem.T_cam_world[2], atol=1e-5 * size)


def test_a_sweep_allocates_nothing(start):
    """Counted by numba's own runtime, which also counts one for each array that Python hands over."""
    runtime = pytest.importorskip("numba.core.runtime")
    runtime._nrt_python.memsys_enable_stats()
    variables, scratch = Variables.of(start, pinhole_model(PINHOLE)), new_scratch()
    views, sightings = variables.views(free_slots(start)), sightings_of(start)
    before = runtime.rtsys.get_allocation_stats().alloc
    sweep_cameras(views, sightings, variables.points, 0.25, scratch)
    sweep_points(views, sightings, variables.points, 0.25)
    handed_over = 2 * sum(isinstance(a, np.ndarray) for a in (*views, *sightings, variables.points)) + len(scratch)
    assert runtime.rtsys.get_allocation_stats().alloc - before in (0, handed_over)
