# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from sequences import write_depth, write_picture

from vitamin3d.datasets import kind_of, open_dataset
from vitamin3d.errors import InputError
from vitamin3d.evaluation.reference_surface import cloud_of_depth, depth_maps


def test_seven_scenes(tmp_path, poses):
    for k, pose in enumerate(poses):
        write_picture(tmp_path / "chess" / "seq-01" / f"frame-{k:06d}.color.png")
        write_depth(tmp_path / "chess" / "seq-01" / f"frame-{k:06d}.depth.png", 2000 if k else 65535)
        np.savetxt(tmp_path / "chess" / "seq-01" / f"frame-{k:06d}.pose.txt", pose)
    source = tmp_path / "chess" / "seq-01"
    dataset = open_dataset(source)
    assert (kind_of(source), dataset.name, len(dataset), dataset.camera.fx) == ("7scenes", "chess/seq-01", 4, 585.0)
    assert dataset.timestamps_ns.tolist() == [0, 33_333_333, 66_666_667, 100_000_000]
    np.testing.assert_allclose(dataset.ground_truth().T_world_cam, poses, atol=1e-9)
    assert [m.counts_per_metre for m in depth_maps(source, dataset)] == [1000.0] * 4
    points = cloud_of_depth(source, dataset, dataset.ground_truth())
    inside = (points - poses[1][:3, 3]) @ poses[1][:3, :3]
    assert len(points) > 1000 and np.isclose(inside[:, 2], 2.0, atol=0.02).mean() > 0.2
    (source / "frame-000002.pose.txt").write_text("1 0 0 0\n0 1 0 0\n")
    with pytest.raises(InputError, match=r"frame-000002\.pose\.txt"):
        dataset.ground_truth()
