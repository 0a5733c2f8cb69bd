# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.errors import InputError
from vitamin3d.exporters.depth_map import counts_from_depth, read_depth_map, write_depth_map


def test_depth_maps_come_back_to_half_a_count(tmp_path):
    depth = np.array([[0.0, 0.5, 1.2345], [13.0, 14.0, np.nan]], np.float32)
    write_depth_map(depth, tmp_path / "d.png", 5000.0)
    back = read_depth_map(tmp_path / "d.png", 5000.0)
    np.testing.assert_allclose(back, [[0, 0.5, 1.2345], [13.0, 0, 0]], atol=0.5 / 5000)
    assert counts_from_depth(depth, 1.0).dtype == np.uint16
    (tmp_path / "x.png").write_bytes(b"no picture")
    with pytest.raises(InputError):
        read_depth_map(tmp_path / "x.png", 1.0)
