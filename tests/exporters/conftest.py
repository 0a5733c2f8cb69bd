# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.types import Surface


@pytest.fixture
def surface():
    """The square |x|, |y| < 1 at z = 2, facing -z."""
    vertices = np.array([[-1.0, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]])
    triangles = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    colors = np.array([[0, 128, 255], [1, 2, 3], [4, 5, 6], [250, 251, 252]], np.uint8)
    return Surface(vertices, triangles, np.tile([0.0, 0.0, -1.0], (4, 1)), colors)
