# SPDX-License-Identifier: Apache-2.0
import numpy as np

from vitamin3d.mapping.keyframe_views import sample_colors
from vitamin3d.types import Frame


def test_colors_come_from_the_nearest_pixel_inside():
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    color = np.stack([image, image + 100, image + 200], axis=-1)
    pixels = np.array([[1.4, 1.6], [-3.0, 0.0], [9.0, 9.0]])
    np.testing.assert_array_equal(sample_colors(Frame(0, 0, image), pixels), np.repeat([[9], [0], [11]], 3, axis=1))
    np.testing.assert_array_equal(sample_colors(Frame(0, 0, image, color), pixels), [[9, 109, 209], [0, 100, 200], [11, 111, 211]])
