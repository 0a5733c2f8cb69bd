# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scenes import room

from vitamin3d.errors import InputError
from vitamin3d.evaluation.registration import register
from vitamin3d.geometry.se3 import exp_so3

pytestmark = pytest.mark.slow


def test_a_cloud_is_found_in_any_scale_and_frame(rng, scale=7.0):
    target = room(rng)
    R = exp_so3(rng.standard_normal(3) * 2)
    some = target[rng.random(len(target)) < 0.3] + 0.005 * rng.standard_normal((1, 3))
    source = ((some - [1, 2, 3]) @ R + 0.004 * rng.standard_normal(some.shape)) * scale
    found = register(source, target)
    assert found.holds and found.scale == pytest.approx(1 / scale, rel=0.02)
    assert np.median(np.linalg.norm(found.apply(source) - some, axis=1)) < 0.05
    again = register(source, target)
    assert (again.scale, again.overlap) == (found.scale, found.overlap)


def test_unrelated_clouds_are_not_registered(rng):
    found = register(rng.standard_normal((2000, 3)), room(rng))
    assert not found.holds
    with pytest.raises(InputError, match="at least 20 points"):
        register(np.zeros((5, 3)), room(rng))
