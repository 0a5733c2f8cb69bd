# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from sequences import write_depth, write_picture

from vitamin3d.datasets import kind_of, open_dataset
from vitamin3d.evaluation.reference_surface import depth_maps
from vitamin3d.exporters.trajectory import write_tum
from vitamin3d.types import Trajectory


def test_icl_nuim_is_mirrored_into_our_frame(tmp_path, poses):
    for k in range(4):
        write_picture(tmp_path / "rgb" / f"{k}.png")
        write_depth(tmp_path / "depth" / f"{k}.png", 10_000)
    (tmp_path / "associations.txt").write_text("".join(f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in range(4)))
    mirror = np.diag([1.0, -1, 1, 1])
    write_tum(Trajectory(np.arange(1, 4) * 10**9, mirror @ poses[1:] @ mirror), tmp_path / "livingRoom0.gt.freiburg")
    dataset = open_dataset(tmp_path)
    assert (kind_of(tmp_path), len(dataset), dataset.camera.fy) == ("icl", 4, 480.0)
    truth = dataset.ground_truth()
    assert truth.timestamps_ns.tolist() == dataset.timestamps_ns.tolist()[1:]
    np.testing.assert_allclose(truth.T_world_cam, poses[1:], atol=1e-8)
    assert np.linalg.det(truth.T_world_cam[:, :3, :3]) == pytest.approx([1.0] * 3)
    assert [m.counts_per_metre for m in depth_maps(tmp_path, dataset)] == [5000.0] * 4
