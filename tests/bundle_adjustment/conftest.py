# SPDX-License-Identifier: Apache-2.0
"""A scene with noise, and a problem that starts beside its truth."""

import numpy as np
import pytest
from scenes import perturbed, problem_of, with_noise


@pytest.fixture(scope="module")
def noisy(scene):
    return with_noise(scene, np.random.default_rng(5))[0]


@pytest.fixture(scope="module")
def start(noisy):
    poses, points = perturbed(noisy, np.random.default_rng(6))
    return problem_of(noisy, poses=poses, points=points)
