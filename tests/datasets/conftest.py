# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.geometry.se3 import exp_se3


@pytest.fixture
def poses(rng):
    return np.array([exp_se3(0.1 * rng.standard_normal(6)) for _ in range(4)])
