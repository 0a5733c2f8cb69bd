# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
from sequences import frame, message, truth, tum

from vitamin3d.datasets import open_dataset


def test_tum(tmp_path: Path) -> None:
    dataset = open_dataset(tum(tmp_path))
    assert dataset.timestamps_ns.tolist() == [1_000_000_001, 1_033_333_000, 1_066_666_000]
    color = frame(dataset, 1).color
    assert color is not None and color.shape == (48, 64, 3)
    assert truth(dataset).timestamps_ns.tolist() == [1_000_000_000, 1_100_000_000]
    np.testing.assert_allclose(truth(dataset).T_world_cam[1, :3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_tum_mistakes(tmp_path: Path) -> None:
    root = tum(tmp_path)
    (root / "rgb.txt").write_text("1.0 rgb/0.png\n0.9 rgb/1.png\n")
    assert "rgb.txt, line 2: time 0.900000000 s is before that of the line above" in message(root)
    (root / "rgb.txt").write_text("1.0 rgb/0.png\nrgb/1.png 2.0\n")
    assert "rgb.txt, line 2: expected a time in seconds" in message(root)
    (root / "camera.yaml").unlink()
    assert "no calibration" in message(root)
