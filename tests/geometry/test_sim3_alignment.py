# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.errors import InputError
from vitamin3d.geometry.se3 import exp_so3
from vitamin3d.geometry.sim3_alignment import align_sim3


def test_a_similarity_is_recovered(rng):
    source, R, t = rng.standard_normal((20, 3)), exp_so3(np.array([0.4, -2.0, 1.0])), np.array([3.0, -4.0, 5.0])
    s, R_found, t_found = align_sim3(source, 2.5 * source @ R.T + t)
    assert s == pytest.approx(2.5, rel=1e-12)
    np.testing.assert_allclose(R_found, R, atol=1e-12)
    np.testing.assert_allclose(t_found, t, atol=1e-12)


def test_noise_leaves_no_better_similarity(rng):
    source = rng.standard_normal((15, 3))
    target = 0.7 * source @ exp_so3(np.array([0.1, 0.2, 0.3])).T + rng.standard_normal((15, 3)) * 0.05

    def cost(s, R, t):
        return ((target - s * source @ R.T - t) ** 2).sum()

    s, R, t = align_sim3(source, target)
    best = cost(s, R, t)
    assert 0 < best < 0.5
    for axis in np.eye(3):
        for step in (1e-3, -1e-3):
            assert cost(s * (1 + step), R, t) > best
            assert cost(s, exp_so3(step * axis) @ R, t) > best
            assert cost(s, R, t + step * axis) > best


def test_a_mirrored_or_flat_set_still_gets_a_rotation(rng):
    source = rng.standard_normal((10, 3))
    _, R, _ = align_sim3(source, source * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1.0)
    flat = source * [1, 1, 0]
    s, R, _ = align_sim3(flat, 2 * flat @ exp_so3(np.array([0.3, 0, 0])).T)
    assert s == pytest.approx(2.0) and np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_pairs_are_refused(count):
    with pytest.raises(InputError, match=f"at least three pairs of positions, not {count}"):
        align_sim3(np.zeros((count, 3)), np.zeros((count, 3)))


def test_unpaired_and_standing_positions_are_refused(rng):
    with pytest.raises(InputError, match="not 4"):
        align_sim3(np.zeros((5, 3)), np.zeros((4, 3)))
    with pytest.raises(InputError, match="the same"):
        align_sim3(np.ones((5, 3)), rng.standard_normal((5, 3)))


def test_standing_positions_far_from_the_origin_are_refused(rng):
    with pytest.raises(InputError, match="the same"):
        align_sim3(np.full((7, 3), 0.1), rng.standard_normal((7, 3)))
