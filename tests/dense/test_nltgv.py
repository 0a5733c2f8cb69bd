# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
import reference_dense as reference
from scipy.optimize import linprog

from vitamin3d.config import DelaunayConfig, NltgvConfig
from vitamin3d.dense.delaunay import triangulate
from vitamin3d.dense.nltgv import denoise, normalized_problem, objective, solve, vertex_slopes

NORMAL = np.array([0.05, -0.08, 0.4])
GRADIENT = NORMAL[:2] / [reference.SMALL.fx, reference.SMALL.fy]


def plane(count=150, seed=0):
    snapshot = reference.snapshot_of_plane(reference.SMALL, NORMAL, count, np.random.default_rng(seed))
    return triangulate(snapshot, DelaunayConfig(min_vertices=3))


def noisy(mesh, sigma, seed=1):
    factors = 1 + sigma * np.random.default_rng(seed).standard_normal(len(mesh.pixels))
    return dataclasses.replace(mesh, inverse_depth=mesh.inverse_depth * factors)


def zero_slopes(problem):
    return np.column_stack([problem.data, np.zeros((len(problem.data), 2))])


def test_slopes_of_a_plane_are_its_gradient():
    np.testing.assert_allclose(vertex_slopes(plane()), np.broadcast_to(GRADIENT, (len(plane().pixels), 2)), atol=1e-12)


def test_a_plane_is_a_fixed_point():
    mesh = plane()
    result = denoise(mesh, NltgvConfig(iterations=200))
    np.testing.assert_allclose(result.mesh.inverse_depth, mesh.inverse_depth, rtol=1e-12)
    np.testing.assert_allclose(result.slopes, np.broadcast_to(GRADIENT, result.slopes.shape), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(result.energies, 0.0, atol=1e-9)


def test_a_plane_is_found_from_no_slopes():
    problem = normalized_problem(plane(), NltgvConfig())
    state = solve(problem, zero_slopes(problem), 3000)
    np.testing.assert_allclose(state[:, 0], problem.data, atol=1e-4)
    assert objective(problem, state) < 1e-2 * objective(problem, zero_slopes(problem))


def test_a_lone_outlier_is_pulled_to_its_plane():
    mesh = plane()
    inside = int(np.argmin(np.linalg.norm(mesh.pixels - [64, 48], axis=1)))
    spoilt = mesh.inverse_depth.copy()
    spoilt[inside] *= 1.3
    deviation = np.full(len(spoilt), NltgvConfig().full_deviation)
    result = denoise(
        dataclasses.replace(mesh, inverse_depth=spoilt, relative_deviation=deviation), NltgvConfig(iterations=2000, data_weight=1.0)
    )
    np.testing.assert_allclose(result.mesh.inverse_depth, mesh.inverse_depth, rtol=2e-3)


def test_a_depth_step_survives():
    mesh = plane(600)
    step = np.where(mesh.pixels[:, 0] < 64, 1.0, 0.6)
    result = denoise(noisy(dataclasses.replace(mesh, inverse_depth=step), 0.01), NltgvConfig(iterations=1000))
    inner = np.abs(mesh.pixels[:, 0] - 64) > 6
    assert np.abs(result.mesh.inverse_depth[inner] - step[inner]).max() < 0.04
    assert np.median(np.abs(result.mesh.inverse_depth[inner] - step[inner])) < 0.006


def test_noise_falls_and_certain_vertices_lead():
    mesh = plane(400)
    deviations = np.where(np.arange(len(mesh.pixels)) % 4 == 0, 0.002, 0.05)
    measured = dataclasses.replace(noisy(mesh, 1.0 * deviations), relative_deviation=deviations)
    result = denoise(measured, NltgvConfig())
    error_before = np.abs(measured.inverse_depth / mesh.inverse_depth - 1).mean()
    error_after = np.abs(result.mesh.inverse_depth / mesh.inverse_depth - 1).mean()
    assert 0 < error_after < 0.15 * error_before


def test_reported_energy_is_the_minimised_one():
    mesh = noisy(plane(), 0.05)
    results = [denoise(mesh, NltgvConfig(iterations=n)) for n in (0, 50, 500)]
    problem = normalized_problem(mesh, NltgvConfig())
    for result in results:
        unit = mesh.inverse_depth.mean()
        state = np.column_stack([result.mesh.inverse_depth, 8.0 * result.slopes]) / unit
        assert result.energies[1] == pytest.approx(reference.nltgv_objective(problem, state), rel=1e-9)
    assert results[0].energies[0] == results[0].energies[1]
    assert results[2].energies[1] < results[1].energies[1] < results[0].energies[1]


def test_the_minimum_is_that_of_a_linear_programme():
    """min |K x|_1 + sum of weights |xi - z|, with a bound variable for each absolute value."""
    problem = normalized_problem(noisy(plane(25), 0.1), NltgvConfig())
    K = np.vstack([reference.nltgv_matrix(problem), np.zeros((len(problem.data), 3 * len(problem.data)))])
    first = 3 * len(problem.edges)
    K[np.arange(first, len(K)), np.arange(0, K.shape[1], 3)] = problem.data_weights
    offset = np.concatenate([np.zeros(first), problem.data_weights * problem.data])
    identity = np.eye(len(K))
    costs = np.concatenate([np.zeros(K.shape[1]), np.ones(len(K))])
    bounds = [(None, None)] * K.shape[1] + [(0, None)] * len(K)
    best = linprog(costs, np.block([[K, -identity], [-K, -identity]]), np.concatenate([offset, -offset]), bounds=bounds)
    reached = objective(problem, solve(problem, zero_slopes(problem), 20_000))
    assert best.fun == pytest.approx(reached, rel=1e-4)
    assert reached > best.fun - 1e-9


@pytest.mark.parametrize("iterations", [0, 1, 25])
def test_kernel_equals_its_twin(iterations):
    problem = normalized_problem(noisy(plane(40), 0.1), NltgvConfig(slope_weight=0.7))
    start = zero_slopes(problem)
    expected = reference.nltgv_solve(problem, start, iterations)
    np.testing.assert_allclose(solve(problem, start, iterations), expected, rtol=1e-10, atol=1e-12)
    assert objective(problem, expected) == pytest.approx(reference.nltgv_objective(problem, expected))


def test_the_unit_of_the_map_does_not_matter():
    mesh = noisy(plane(), 0.05)
    scaled = denoise(dataclasses.replace(mesh, inverse_depth=250.0 * mesh.inverse_depth), NltgvConfig(iterations=100))
    result = denoise(mesh, NltgvConfig(iterations=100))
    np.testing.assert_allclose(scaled.mesh.inverse_depth, 250.0 * result.mesh.inverse_depth, rtol=1e-7)
    np.testing.assert_allclose(scaled.slopes, 250.0 * result.slopes, rtol=1e-5, atol=1e-9)


def test_switched_off_it_changes_nothing():
    mesh = noisy(plane(), 0.05)
    result = denoise(mesh, NltgvConfig(enabled=False))
    np.testing.assert_allclose(result.mesh.inverse_depth, mesh.inverse_depth, rtol=1e-12)


def test_small_primal_steps_save_iterations():
    mesh = noisy(plane(3000), 0.05)
    few, unscaled = (denoise(mesh, NltgvConfig(iterations=50, primal_share=share)).energies[1] for share in (0.03, 1.0))
    best = denoise(mesh, NltgvConfig(iterations=3000)).energies[1]
    assert best < few < 1.1 * best and few < 0.9 * unscaled
