# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np

from vitamin3d.exporters.depth_map import counts_from_depth, write_depth_map


def test_depth_maps_come_back_to_half_a_count(tmp_path):
    depth = np.array([[0.0, 0.5, 1.2345], [13.0, 14.0, np.nan]], np.float32)
    write_depth_map(depth, tmp_path / "d.png", 5000.0)
    back = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED).astype(np.float64) / 5000.0
    np.testing.assert_allclose(back, [[0, 0.5, 1.2345], [13.0, 0, 0]], atol=0.5 / 5000)
    assert counts_from_depth(depth, 1.0).dtype == np.uint16
