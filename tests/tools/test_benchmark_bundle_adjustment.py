# SPDX-License-Identifier: Apache-2.0
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from scenes import PINHOLE, arc_scene, perturbed, problem_of, with_noise

from vitamin3d.geometry.se3 import exp_se3, inverse

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
import benchmark_bundle_adjustment as tool


@pytest.fixture(autouse=True)
def _all_cores():
    """The tool keeps to one core; the tests after it need not."""
    import os

    before = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    yield
    if before is not None:
        os.sched_setaffinity(0, before)


@pytest.fixture
def window(tmp_path):
    rng = np.random.default_rng(0)
    scene, _ = with_noise(arc_scene(6, 150, rng), rng)
    poses, points = perturbed(scene, rng, 0.001, 0.005)
    lens = PINHOLE.with_model([520.0, 510.0, 321.5, 239.0, -0.1, 0.02, 0.0, 0.0])
    problem = problem_of(scene, 2, poses, points)
    tool.save_problem(tmp_path / "window.npz", problem, lens, (inverse(scene.T_cam_world), scene.points))
    return tmp_path / "window.npz", problem, lens


def test_a_recorded_problem_comes_back(window):
    path, problem, lens = window
    loaded, camera = tool.load_problem(path)
    assert camera == lens
    np.testing.assert_allclose(loaded.obs_pixels, problem.obs_pixels, atol=1e-6)
    np.testing.assert_array_equal(loaded.obs_point, problem.obs_point)
    np.testing.assert_array_equal(loaded.camera_is_free, problem.camera_is_free)


@pytest.mark.slow
def test_windows_sweeps_and_map_print_their_tables(window, capsys, monkeypatch):
    monkeypatch.setattr(tool, "ceres_solver", lambda: None)
    of_windows = ("live start", "perturbed", "schur", "errors within 5 % after", " ms")
    for command, words in (("windows", of_windows), ("sweeps", ("million/s",)), ("map", ("ours", "k1"))):
        assert tool.main([command, str(window[0])]) == 0
        printed = capsys.readouterr().out
        assert all(word in printed for word in words), printed


def test_the_perturbation_has_its_size_and_leaves_the_fixed_alone(window):
    _, problem, _ = window
    moved = tool.perturbed(problem, 1.0, np.random.default_rng(0))
    np.testing.assert_array_equal(moved.T_cam_world[:2], problem.T_cam_world[:2])
    way, angle, points = tool.distances(moved, problem)
    assert 0.01 < way < 0.03 and 0.4 < angle < 1.6 and 0.03 < points < 0.2


def test_errors_are_those_from_the_truth_in_any_world(window):
    path, problem, _ = window
    truth = tool.load_truth(path)
    exact = dataclasses.replace(problem, T_cam_world=inverse(truth[0]), points_world=truth[1])
    np.testing.assert_allclose(tool.errors(exact, truth), 0.0, atol=1e-6)
    turned = exact.T_cam_world.copy()
    turned[4] = exp_se3([0, 0, 0, 0.02, 0, 0]) @ turned[4]
    found = tool.errors(dataclasses.replace(exact, T_cam_world=turned, points_world=2.0 * truth[1]), truth)
    assert found[1] == pytest.approx(np.degrees(0.02) / 2, rel=0.05)
    assert found[2] > 0.5 and found[0] < 1e-6  # it turns about its centre


def test_what_is_no_problem_is_one_line(tmp_path, capsys):
    (tmp_path / "x.txt").write_text("no numbers")
    assert tool.main(["bal", str(tmp_path / "x.txt")]) == 2
    assert "x.txt" in capsys.readouterr().err
