# SPDX-License-Identifier: Apache-2.0
import bz2
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vitamin3d.bundle_adjustment.adjust import AdjustmentSettings, adjust
from vitamin3d.bundle_adjustment.variables import Variables, squared_errors_of
from vitamin3d.datasets.bal import read_bal
from vitamin3d.errors import InputError

SHARED = Path(__file__).parents[3] / "shared" / "data" / "bal"


def bal_residual(camera, point, pixel):
    """The projection as the BAL page has it."""
    P = Rotation.from_rotvec(camera[:3]).apply(point) + camera[3:6]
    p = -P[:2] / P[2]
    r2 = p @ p
    return camera[6] * (1 + camera[7] * r2 + camera[8] * r2**2) * p - pixel


@pytest.fixture
def problem(rng):
    """Cameras (4, 9), points (30, 3), rows of (camera, point, pixel), and their text."""
    cameras = np.column_stack([0.1 * rng.standard_normal((4, 6)), [500, 510, 490, 505], 0.05 * rng.standard_normal((4, 2))])
    points = rng.uniform([-2, -2, -8], [2, 2, -4], (30, 3))
    rows = [(c, p, *(bal_residual(cameras[c], points[p], 0) + 0.5 * rng.standard_normal(2))) for p in range(30) for c in range(4)]
    numbers = [*(f"{c} {p} {x} {y}" for c, p, x, y in rows), *map(str, cameras.ravel()), *map(str, points.ravel())]
    return cameras, points, rows, "\n".join(["4 30 120", *numbers])


def test_our_residual_is_that_of_bal(problem, tmp_path):
    cameras, points, rows, text = problem
    for name, data in (("p.txt", text.encode()), ("p.txt.bz2", bz2.compress(text.encode()))):
        (tmp_path / name).write_bytes(data)
        read, models = read_bal(tmp_path / name)
        errors = squared_errors_of(read, Variables.of(read, models))
        expected = [np.square(bal_residual(cameras[c], points[p], [x, y])).sum() for c, p, x, y in np.array(rows, object)[read.obs_rows]]
        np.testing.assert_allclose(errors, expected, rtol=1e-9)
        np.testing.assert_array_equal(read.points_world, points)


def test_it_is_solved_with_each_cameras_own_parameters(problem, tmp_path):
    (tmp_path / "p.txt").write_text(problem[3])
    read, models = read_bal(tmp_path / "p.txt")
    adjusted = adjust(read, models, AdjustmentSettings(sigma_px=np.inf, free=("f", "k1", "k2"), own=True))
    degrees = 2 * 120 - 3 * 9 - 3 * 30
    assert adjusted.report.costs[-1] == pytest.approx(0.25 * degrees, rel=0.35)
    np.testing.assert_allclose(adjusted.models[:, 0], adjusted.models[:, 1])


@pytest.mark.parametrize(
    "spoil",
    [lambda t: t[:200], lambda t: "a b c", lambda t: "", lambda t: t.replace("4 30 120\n0 0", "4 30 120\n9 0"), lambda t: t + "\n7"],
)
def test_what_is_no_bal_problem_is_an_input_error(spoil, problem, tmp_path):
    (tmp_path / "p.txt").write_text(spoil(problem[3]))
    with pytest.raises(InputError, match=r"p\.txt"):
        read_bal(tmp_path / "p.txt")
    with pytest.raises(InputError, match=r"none\.txt"):
        read_bal(tmp_path / "none.txt")


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize(("name", "expected"), [("16-22106", 59100.4), ("49-7776", 13713.2)])
def test_the_real_problems_reach_their_minimum(name, expected):
    path = SHARED / f"problem-{name}-pre.txt.bz2"
    if not path.exists():
        pytest.skip("no shared data")
    problem, models = read_bal(path)
    adjusted = adjust(problem, models, AdjustmentSettings(sigma_px=np.inf, free=("f", "k1", "k2"), own=True))
    assert adjusted.report.costs[-1] / 2 == pytest.approx(expected, rel=1e-3)
