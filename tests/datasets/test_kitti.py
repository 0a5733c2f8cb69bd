# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest
from sequences import kitti, message, truth, write_picture

from vitamin3d.datasets import open_dataset
from vitamin3d.errors import InputError


@pytest.mark.parametrize(("folder", "focal"), [("image_0", 60.0), ("image_2", 61.0)])
def test_kitti(tmp_path: Path, folder: str, focal: float) -> None:
    dataset = open_dataset(kitti(tmp_path, folder))
    assert (dataset.camera.fx, dataset.camera.width, dataset.camera.height) == (focal, 64, 48)
    assert dataset.timestamps_ns.tolist() == [0, 103_622_400, 200_000_000]
    np.testing.assert_array_equal(truth(dataset).T_world_cam[:, 0, 3], [0, 1, 2])


def test_kitti_other_truth(tmp_path: Path) -> None:
    root = kitti(tmp_path)
    (root / "poses.txt").unlink()
    assert open_dataset(root).ground_truth() is None
    (root / "groundtruth.tum").write_text("0 1 2 3 0 0 0 1\n")
    assert len(truth(open_dataset(root))) == 1


def test_kitti_mistakes(tmp_path: Path) -> None:
    root = kitti(tmp_path)
    (root / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    with pytest.raises(InputError, match=r"poses.txt, line 4: more poses than the 3 times"):
        open_dataset(root).ground_truth()
    (root / "times.txt").write_text("0\n1\n")
    assert "times.txt: 2 times for 3 pictures" in message(root)
    (root / "times.txt").write_text("0\n1\n1\n")
    assert "times.txt, line 3: time 1.000000000 s is equal to" in message(root)
    (root / "times.txt").write_text("0\n1\n2\n")
    (root / "calib.txt").unlink()
    assert "no calibration" in message(root)


def test_kitti_with_its_poses_in_a_folder_of_their_own(tmp_path, poses):
    source = tmp_path / "dataset" / "sequences" / "07"
    for k in range(4):
        write_picture(source / "image_0" / f"{k:06d}.png")
    (source / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    (source / "calib.txt").write_text("P0: 500 0 320 0 0 500 240 0 0 0 1 0\n")
    (tmp_path / "dataset" / "poses").mkdir()
    np.savetxt(tmp_path / "dataset" / "poses" / "07.txt", poses[:, :3].reshape(4, 12))
    np.testing.assert_allclose(open_dataset(source).ground_truth().T_world_cam, poses, atol=1e-9)
