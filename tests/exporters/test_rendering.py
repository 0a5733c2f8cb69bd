# SPDX-License-Identifier: Apache-2.0
import numpy as np

from vitamin3d.exporters.rendering import draw_points, side_by_side
from vitamin3d.geometry.cameras import PinholeCamera

CAMERA = PinholeCamera(100.0, 100.0, 49.5, 39.5, 100, 80)


def test_the_nearest_point_is_in_front():
    points, colors = (
        np.array([[0, 0, 4.0], [0, 0, 2.0], [0.5, 0, 2.0], [0, 0, -1]]),
        np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9]]),
    )
    for order in ([0, 1, 2, 3], [1, 0, 3, 2]):
        picture = draw_points(points[order], colors[order].astype(np.uint8), CAMERA, np.eye(4), 1.5)
        assert picture.shape == (80, 100, 3)
        assert picture[40, 50].tolist() == [0, 255, 0] and picture[40, 75].tolist() == [0, 0, 255]
        assert (picture != 255).any(axis=-1).sum() == 18  # two discs of nine pixels: the third is hidden
    assert (draw_points(np.zeros((0, 3)), None, CAMERA, np.eye(4)) == 255).all()


def test_panels_are_laid_out_in_rows():
    panels = [np.full((20, 60, 3), k * 40, np.uint8) for k in range(4)]
    page = side_by_side(panels, list("abcd"), columns=3)
    assert page.shape == (2 * (20 + 26 + 6) - 6, 3 * 66 - 6, 3)
    assert page[30, 70].tolist() == [40] * 3 and page[-10, 10].tolist() == [120] * 3 and page[-10, 100].tolist() == [255] * 3
